"""What the planner's node publishes: plans, how they were found, and what happened to goals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.plan_messages import to_markers, to_path, to_references, to_request, to_statistics
from contact_reach_ros.messages.plan_request import request_parts
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.receding_horizon import Memory
from contact_reach_ros.ros.managed_node import ManagedNode

_MARKERS_EVERY_NS = _GOAL_STATE_EVERY_NS = 100_000_000


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
        self._statistics.publish(to_statistics(plan, numbers, self._name, self._arm))
        self._requests.publish(to_request(request_parts(plan.number, request, start, found.best)))

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
