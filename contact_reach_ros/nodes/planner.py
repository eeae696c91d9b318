"""The planner: goals in, paired references out, re-planned continuously.

The loop thread is the worker that solves; the executor meanwhile serves services in a thread of its own.
"""

from __future__ import annotations

import array
import dataclasses
import sys
import time
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS, ControllerSettings
from contact_reach_ros.errors import ContactReachError, FrameError, InputError, SettingsError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_status
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.messages.plan_request import Parts, request_parts
from contact_reach_ros.messages.safety_state import is_stopped, read_contact
from contact_reach_ros.messages.serialized import JointStateReader, decode
from contact_reach_ros.messages.values import goal_values, nanoseconds, quaternion, vector
from contact_reach_ros.nodes.planner_output import to_header, to_markers, to_path, to_references
from contact_reach_ros.observer.budget import BUDGET, load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.receding_horizon import Memory, RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PLANNER_SECTIONS, PlannerNodeSettings
from contact_reach_ros.ros.frames import Frames
from contact_reach_ros.ros.graph import controllers
from contact_reach_ros.ros.inbox import LARGEST_SCENE
from contact_reach_ros.ros.interfaces import CONTROLLER, OBSERVER
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import run
from contact_reach_ros.timing import Durations
from contact_reach_ros.world.goal import POSE, Goal

_POLL_NS = 3_000_000
_SHOWN_EVERY_NS = 100_000_000
"""Time between markers of plans, and between states of a goal that is pursued, ns."""


class PlannerNode(ManagedNode):
    """Passes goals, obstacles, contacts and joint states to the planner and publishes its plans."""

    NAME = "planner"
    SECTIONS = PLANNER_SECTIONS
    _core: RecedingHorizonPlanner
    """Made by `configure`."""

    def __init__(self) -> None:
        super().__init__()
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self.inbox.add(topics.OBSTACLES, self._on_obstacles, serialized=True, largest=LARGEST_SCENE)
        self.inbox.add(topics.GOAL_POSE, self._on_goal)
        settings: PlannerNodeSettings = self.settings[""]
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        observer = settings_of(self.ARGUMENTS, OBSERVER, OBSERVER_SECTIONS, self.arm)[""]
        self.settings[BUDGET] = load_budget(observer.contact_budget).resolve(self.arm)
        # Plans hold for this controller only.
        self.settings |= settings_of(self.ARGUMENTS, CONTROLLER, CONTROLLER_SECTIONS, self.arm)
        self._planner = Planner(
            self.arm,
            None,
            settings,
            self.settings["unexpected_contact"],
            self.refuse,
            self.settings["impedance"].task,
            self.settings[BUDGET],
        )
        self._poses = self.make_publisher(topics.REFERENCE_POSE)
        self._postures = self.make_publisher(topics.REFERENCE_POSTURE)
        self._path = self.make_publisher(topics.PLAN_PATH)
        self._goal_states = self.make_publisher(topics.GOAL_STATE)
        self._markers = self.make_publisher(topics.PLAN_MARKERS)
        self._statistics = self.make_publisher(topics.PLAN_STATISTICS)
        self._requests = self.make_publisher(topics.PLAN_REQUEST)
        self._markers_due_ns = self._goal_state_due_ns = 0
        self._reported: GoalPhase | None = None
        self._obstacle_reader = ObstacleMarkerReader(self.arm.base_frame, settings)
        self._frames = Frames(self, self.arm.base_frame)
        self._goals = self._goal_ns = 0
        """Number of goals that were taken, and the stamp of the last one."""
        self._seen_ns = 0
        """When the obstacles were sent, ns since the epoch."""
        self._stops: dict[str, str] = {}
        """Why the arm is stopped, by the node that stopped it."""
        self._late = self._detour = 0
        """Number of late plans, and of the detour that the arm is on; 0 for none."""
        self._solve_times = Durations()
        # Nothing is planned from what two arms report in turns.
        self.exclude([topics.JOINT_STATES, topics.SAFETY_STATE])
        self.add_on_set_parameters_callback(self._on_speed)
        # States arrive much faster than plans are made; handling each would only take time from the loops.
        self.follow(topics.JOINT_STATES, self._on_state, hurried=False)

    def configure(self) -> None:
        """Compile the solver, and load what reads obstacles and explains contact: plans would wait for it later."""
        import_module("scipy.optimize")
        import_module("scipy.sparse.csgraph")
        import_module("scipy.spatial")
        self._planner.core = self._core = RecedingHorizonPlanner(
            self.arm,
            self.settings["planning"],
            ControllerSettings.from_sections(self.settings),
            self.settings[BUDGET].permitted_force,
            self.settings[""].max_spheres,
        )
        self._core.warm_up(lambda line: self.get_logger().info(line))

    def _on_speed(self, parameters: list[Parameter]) -> SetParametersResult:
        """Use another `speed_scale` from the next plan on: all other parameters are read-only."""
        try:
            chosen = dataclasses.replace(self.settings[""], **{one.name: one.value for one in parameters})
        except SettingsError as error:
            self.refuse("parameters", error)
            return SetParametersResult(successful=False, reason=str(error))
        self.settings[""], self._planner.speed_scale = chosen, chosen.speed_scale
        if self.running:
            self.publish_settings()
        return SetParametersResult(successful=True)

    def activate(self) -> None:
        """Wait for a goal, and refuse those that have come before: the inbox has them before any joint state."""
        self._withdraw("the planner was activated")
        self._planner.state = None
        self.describe_robot()

    def describe_robot(self) -> None:
        """Publish the robot's description unless somebody else does, as the drivers of real robots may."""
        if not self.count_publishers(self.resolve_topic_name(topics.ROBOT_DESCRIPTION.name)):
            self.make_publisher(topics.ROBOT_DESCRIPTION).publish(String(data=build_urdf(self.arm)))

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Goals, solve times, obstacles, and what the planner waits for; `plan/statistics` has the plans."""
        heard_by = controllers(self)
        values: dict[str, Any] = {
            "heard by": ", ".join(heard_by),
            "goals": self._goals,
            "late plans": self._late,
            **{f"solve {key} us": value for key, value in self._solve_times.summary().items()},
        }
        planner = self._planner
        if self.rivals or planner.state is None:
            return self.rivals or topics.WAITING_FOR_STATE, values
        now_ns, obstacles = planner.state.stamp_ns, planner.obstacles
        values |= {"spheres": len(obstacles.spheres), "obstacle age s": obstacles.age(now_ns)}
        problem = obstacles.problem(now_ns)
        if problem:
            return problem if obstacles.are_seen else topics.WAITING_FOR_OBSTACLES, values
        if planner.goal is not None:
            return "planning", values
        return "waiting for a goal" if heard_by else topics.WAITING_FOR_CONTROLLER, values

    def turn(self) -> None:
        """Handle what has arrived; `_on_state` plans when a plan is due."""
        self.inbox.wait(_POLL_NS)

    def _on_state(self, data: bytes) -> None:
        had_goal, request = self._planner.has_goal, self._planner.request(self._reader.read(data))
        if request is not None:
            try:
                self._make_plan(request)
            except ContactReachError as error:
                self.refuse("plans", error)
        state = self._planner.goal_state
        if had_goal and not self._planner.has_goal and state is not None:
            self.get_logger().warning(f"goal {state.phase.value}: {state.reason}")
            self._publish_nothing()
        self._follow_goal()

    def _make_plan(self, request: Request) -> None:
        began_ns, now_ns = time.monotonic_ns(), self.now_ns
        memory = self._core.memory
        try:
            plan = self._planner.solve(request)
            poses, postures = to_references(plan, self.arm)
            self._poses.publish(poses)
            self._postures.publish(postures)
            self._path.publish(to_path(plan, self.arm))
        finally:
            # Simulated time stands still while a plan is made.
            passed_ns = self.now_ns - now_ns
            self._planner.took(passed_ns)
        took_ns = time.monotonic_ns() - began_ns
        self._solve_times.add(took_ns)
        self._late += passed_ns > request.effect_ns - request.state_ns
        if plan.effect_ns >= self._markers_due_ns:
            self._markers.publish(to_markers(plan, self.arm))
            self._markers_due_ns = plan.effect_ns + _SHOWN_EVERY_NS
        found = self._core.memory
        if found is not None:
            self._report_detour(found)
            numbers = {
                "plan": plan.number,
                "state ns": request.state_ns,
                "plans since reset": found.plans - 1,
                "stop reason": plan.stop_reason,
                "solve ms": 1000 * plan.solve_s,
                **plan.statistics(),
                "obstacles sent ns": self._seen_ns,
                "took ms": took_ns / 1e6,
                "contact share": found.approach.share,
                **goal_values(request.goal.position),
            }
            status = to_status(self.NAME, plan.stop_reason, numbers)
            self._statistics.publish(DiagnosticArray(header=to_header(plan.effect_ns, self.arm), status=[status]))
            # The planner has already counted this plan; an arm that jumped made it forget what it had.
            self._record(request_parts(plan.number, request, memory if found.plans > 1 else None, found.best))

    def _record(self, parts: Parts) -> None:
        """Publish for bags what is needed to solve a plan again, one part after the other; the dimensions name them."""
        message = Float64MultiArray(data=array.array("d", np.concatenate(list(parts.values())).tobytes()))
        message.layout.dim = [MultiArrayDimension(label=name, size=part.size) for name, part in parts.items()]
        self._requests.publish(message)

    def _publish_nothing(self) -> None:
        """Publish references without a knot, so that the controller holds the arm at once, and remove the markers."""
        self._poses.publish(MultiDOFJointTrajectory())
        self._postures.publish(JointTrajectory(joint_names=self.arm.joint_names))
        self._markers.publish(to_markers(None, self.arm))

    def _report_goal(self, state: GoalState, stamp_ns: int) -> None:
        """Publish what happened to a goal that was sent at `stamp_ns`."""
        self._reported = state.phase
        self._goal_states.publish(to_goal_state(state, stamp_ns, self.NAME, self.arm))

    def _follow_goal(self, is_new: bool = False) -> None:
        """Publish what happened to the last goal when that changes; on its way some times a second."""
        state, seen = self._planner.goal_state, self._planner.state
        if state is None:
            return
        now_ns = 0 if seen is None else seen.stamp_ns
        # Also after the clock was set back.
        is_due = not 0 < self._goal_state_due_ns - now_ns <= _SHOWN_EVERY_NS
        if is_new or state.phase is not self._reported or (state.phase.is_open and is_due):
            self._report_goal(state, self._goal_ns)
            self._goal_state_due_ns = now_ns + _SHOWN_EVERY_NS

    def _report_detour(self, memory: Memory) -> None:
        """Log a detour that begins: the arm moves away from its goal."""
        detour, number = memory.request.detour, memory.request.on_detour
        if detour is not None and number > self._detour:
            posture = np.round(detour.postures[-1], 2).tolist()
            self.get_logger().info(f"goal {self._goals}: no progress; a detour leads to the posture {posture} rad")
        self._detour = number

    def _on_goal(self, message: PoseStamped) -> None:
        """Take a goal; one that goes on with a stream is neither counted nor logged."""
        stamp_ns, before = nanoseconds(message.header.stamp), self._planner.goal_state
        try:
            self._planner.start_of(stamp_ns)
            if self.rivals:
                raise InputError(f"{self.rivals}: no goal is taken; end the others")
            if self._frames.is_foreign(message.header):
                return self._frames.publish_goal(message)
            pose, kept = message.pose, self.settings[""].goal_orientation
            orientation = quaternion(pose.orientation) if kept == POSE else kept
            goal = Goal(vector(pose.position), orientation)
            for name, why in self._stops.items():
                # The arm would move as soon as it is reset.
                raise InputError(f"goal: {name} has stopped the arm ({why}); first: contact-reach reset")
            goes_on = self._planner.command(goal, stamp_ns)
        except InputError as error:
            self._report_goal(GoalState(GoalPhase.REFUSED, str(error)), stamp_ns)
            raise
        last_ns, self._goal_ns = self._goal_ns, stamp_ns
        if goes_on:
            return
        if before is not None and before.phase.is_open:
            replaced = before._replace(phase=GoalPhase.WITHDRAWN, reason="another goal has replaced it")
            self._report_goal(replaced, last_ns)
        self._follow_goal(is_new=True)
        self._goals += 1
        self.get_logger().info(f"goal {self._goals}: {np.round(np.asarray(goal.position), 3).tolist()} m")

    def _on_obstacles(self, data: bytes) -> None:
        try:
            spheres = self._obstacle_reader.read(data)
        except FrameError:
            self._frames.publish_obstacles(decode(data, MarkerArray, topics.OBSTACLES.name))
        else:
            self._planner.see(spheres, self._obstacle_reader.stamp_ns)
            self._seen_ns = self.inbox.sent_ns

    def _on_safety(self, message: DiagnosticStatus) -> None:
        self._stops.pop(message.name, None)
        if is_stopped(message):
            self._stops[message.name] = message.message
            self._give_up(f"{message.name} stopped the arm ({message.message})")
        elif message.name == OBSERVER:
            why = self._planner.objection(read_contact(message, self.arm))
            if why:
                self._give_up(why)

    def on_rivals(self) -> None:
        """Withdraw the goal."""
        self.inbox.post(lambda: self._give_up(self.rivals))

    def _give_up(self, why: str) -> None:
        """Forget the goal, if there is one, with a line in the log."""
        if self._planner.has_goal:
            self.get_logger().warning(f"goal withdrawn: {why}")
            self._withdraw(why)

    def _withdraw(self, why: str) -> None:
        """Forget the goal: after a stop the arm moves again only with a new one."""
        if self._planner.plan is not None:
            self._publish_nothing()
        self._planner.withdraw(why)
        self._follow_goal()


if __name__ == "__main__":
    sys.exit(run(PlannerNode, sys.argv))
