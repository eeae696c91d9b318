"""What the planner's node publishes: plans, how they were found, and what happened to goals."""

from __future__ import annotations

import array
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Transform, Vector3
from nav_msgs.msg import Path
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_marker, to_point, to_quaternion, to_status, to_time
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.plan_reader import CONTACT, ELBOW, FLANGE
from contact_reach_ros.messages.plan_request import request_parts
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.receding_horizon import Memory
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.collision import capsule_segments

_MARKERS_EVERY_NS = _GOAL_STATE_EVERY_NS = 100_000_000
_SHOWN_FORCE = 0.05
"""Least force that is worth a text, N."""
_TEXT_HEIGHT = 0.04
_PATH_WIDTH = 0.006
_BLUE = (0.2, 0.4, 0.9, 0.9)
_ORANGE = (0.9, 0.55, 0.1, 0.9)


class PlannerOutput:
    """Turns plans and goal states into messages."""

    def __init__(self, node: ManagedNode) -> None:
        """`node`: that publishes."""
        self._name, self._arm = node.NAME, node.arm
        self._poses = node.make_publisher(topics.REFERENCE_POSE)
        self._postures = node.make_publisher(topics.REFERENCE_POSTURE)
        self._path = node.make_publisher(topics.PLAN_PATH)
        self._goal_states = node.make_publisher(topics.GOAL_STATE)
        self._marker_publisher = node.make_publisher(topics.PLAN_MARKERS)
        self._statistics = node.make_publisher(topics.PLAN_STATISTICS)
        self._requests = node.make_publisher(topics.PLAN_REQUEST)
        self._markers_due_ns = 0
        self._reported: GoalPhase | None = None
        self._goal_state_due_ns = 0

    def publish(self, plan: Plan) -> None:
        """Publish the references of a plan, which the controller follows, and its path."""
        poses, postures = to_references(plan, self._arm)
        self._poses.publish(poses)
        self._postures.publish(postures)
        self._path.publish(to_path(plan, self._arm))

    def show(self, plan: Plan) -> None:
        """Publish the markers of a plan, a few times a second."""
        if plan.effect_ns >= self._markers_due_ns:
            self._marker_publisher.publish(to_markers(plan, self._arm))
            self._markers_due_ns = plan.effect_ns + _MARKERS_EVERY_NS

    def withdraw(self) -> None:
        """Publish references without a knot, so that the controller holds the arm at once, and remove the markers."""
        self._poses.publish(MultiDOFJointTrajectory())
        self._postures.publish(JointTrajectory(joint_names=self._arm.joint_names))
        self._marker_publisher.publish(to_markers(None, self._arm))

    def record(
        self, plan: Plan, request: Request, start: Memory | None, found: Memory, values: Mapping[str, Any]
    ) -> None:
        """Publish for bags how a plan was found, and what is needed to solve it again.

        Parameters
        ----------
        plan, request
            The plan and what was asked for.
        start, found
            What the solver knew before, None for an arm that jumped, and knows now.
        values
            Added to the statistics.
        """
        numbers = {
            "plan": plan.number,
            "state ns": request.state_ns,
            "plans since reset": found.plans - 1,
            "stop reason": plan.stop_reason,
            "solve ms": 1000 * plan.solve_s,
            **plan.statistics(),
            **values,
        }
        status = to_status(self._name, plan.stop_reason, numbers)
        self._statistics.publish(DiagnosticArray(header=_header(plan.effect_ns, self._arm), status=[status]))
        # One part after the other; the dimensions name them.
        parts, message = request_parts(plan.number, request, start, found.best), Float64MultiArray()
        message.layout.dim = [MultiArrayDimension(label=name, size=part.size) for name, part in parts.items()]
        message.data = array.array("d", np.concatenate(list(parts.values())).tobytes())
        self._requests.publish(message)

    def report_goal(self, state: GoalState, stamp_ns: int) -> None:
        """Publish what happened to a goal that was sent at `stamp_ns`."""
        self._reported = state.phase
        self._goal_states.publish(to_goal_state(state, stamp_ns, self._name, self._arm))

    def follow_goal(self, planner: Planner, stamp_ns: int, is_new: bool = False) -> None:
        """Publish what happened to the goal, sent at `stamp_ns`, when that changes; on its way some times a second."""
        state, now_ns = planner.goal_state, 0 if planner.state is None else planner.state.stamp_ns
        if state is None:
            return
        # Also after the clock was set back.
        is_due = not 0 < self._goal_state_due_ns - now_ns <= _GOAL_STATE_EVERY_NS
        if is_new or state.phase is not self._reported or (state.phase.is_open and is_due):
            self.report_goal(state, stamp_ns)
            self._goal_state_due_ns = now_ns + _GOAL_STATE_EVERY_NS


def to_references(plan: Plan, arm: Arm) -> tuple[MultiDOFJointTrajectory, JointTrajectory]:
    """The knots of a plan for the controller: poses and postures, paired by their stamp, which is the plan's effect."""
    header = _header(plan.effect_ns, arm)
    poses = MultiDOFJointTrajectory(header=header, joint_names=[arm.tip_frame])
    postures = JointTrajectory(header=header, joint_names=list(arm.joint_names))
    for index, (position, rotation, posture) in enumerate(
        zip(plan.positions, plan.rotations, plan.postures, strict=True), start=1
    ):
        seconds, nanosec = divmod(index * plan.knot_duration_ns, NANOSECONDS)
        end = Duration(sec=seconds, nanosec=nanosec)
        x, y, z = position.tolist()
        transform = Transform(translation=Vector3(x=x, y=y, z=z), rotation=to_quaternion(rotation))
        poses.points.append(MultiDOFJointTrajectoryPoint(transforms=[transform], time_from_start=end))
        postures.points.append(JointTrajectoryPoint(positions=posture.tolist(), time_from_start=end))
    return poses, postures


def to_path(plan: Plan, arm: Arm) -> Path:
    """The tip's predicted positions, from the effect on."""
    path = Path(header=_header(plan.effect_ns, arm))
    for index, position in enumerate(plan.predicted_positions.tolist()):
        pose = PoseStamped(header=_header(plan.effect_ns + index * plan.knot_duration_ns, arm))
        pose.pose.position = to_point(position)
        path.poses.append(pose)
    return path


def _header(time_ns: int, arm: Arm) -> Header:
    return Header(stamp=to_time(time_ns), frame_id=arm.base_frame)


def to_markers(plan: Plan | None, arm: Arm) -> MarkerArray:
    """Paths of flange and elbow, and each link's largest contact force, instead of all that was shown before.

    None shows nothing. A text stands where the link is expected to be at the end of the knot with that force. The
    direction of a force is not known from a plan.
    """
    markers = [Marker(action=Marker.DELETEALL)]
    if plan is not None:
        elbow = np.array([link_frames(arm, q)[1][arm.n // 2] for q in plan.predicted_q])
        markers += [_path(FLANGE, plan.predicted_positions, _BLUE), _path(ELBOW, elbow, _ORANGE), *_forces(plan, arm)]
    for marker in markers:
        marker.header = _header(0 if plan is None else plan.effect_ns, arm)
    return MarkerArray(markers=markers)


def _path(namespace: str, points: Array, color: tuple[float, ...]) -> Marker:
    marker = to_marker(namespace, 0, Marker.LINE_STRIP, (_PATH_WIDTH, 0.0, 0.0), color)
    marker.points = [to_point(point) for point in points.tolist()]
    return marker


def _forces(plan: Plan, arm: Arm) -> Iterator[Marker]:
    links = [arm.link_names[capsule.link - 1] for capsule in arm.capsules]
    for forces, link in zip(plan.predicted_contact_forces.T, arm.contact_links, strict=True):
        knot, index = int(forces.argmax()), links.index(link)
        if forces[knot] >= _SHOWN_FORCE:
            middle = np.mean(capsule_segments(arm, plan.predicted_q[knot + 1]), axis=0)[index]
            number = arm.capsules[index].link
            marker = to_marker(CONTACT, number, Marker.TEXT_VIEW_FACING, (0.0, 0.0, _TEXT_HEIGHT), _ORANGE)
            marker.pose.position = to_point(middle.tolist())
            marker.text = f"{forces[knot]:.1f} N"
            yield marker
