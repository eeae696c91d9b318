"""The planner: goals in, paired references out, re-planned continuously.

The loop thread is the worker that solves; the executor meanwhile serves services in a thread of its own.
"""

from __future__ import annotations

import dataclasses
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock, ClockType
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.bags.goals import goal_values
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import ContactReachError, FrameError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.cdr import decode, stamp_in
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.goals import to_goal
from contact_reach_ros.messages.intake import Taken
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial, ObstacleMarkerReader
from contact_reach_ros.messages.plan_messages import PlanMarkers, to_path, to_references, to_solution, to_statistics
from contact_reach_ros.messages.safety_state import is_stopped, read_contact
from contact_reach_ros.messages.serialized import JointStateReader
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.parameter_files import TOOL_PARAMETERS
from contact_reach_ros.planning.detour import current
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.planning.latency import LatencyEstimate
from contact_reach_ros.planning.node_settings import PLANNER_SECTIONS, SPEED_SCALE, PlannerNodeSettings
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.plan_record import plan_statistics, solution_parts
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.unexpected_contact import ContactReaction
from contact_reach_ros.ros.frames import Frames
from contact_reach_ros.ros.graph import LOOK_AROUND_S, commanders_that_hear, rivalry
from contact_reach_ros.ros.inbox import LARGEST_SCENE
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import run
from contact_reach_ros.ros.scheduling import Role
from contact_reach_ros.settings import Settings
from contact_reach_ros.timing import Histogram

NAME = "planner"

_IDLE_NS = 100_000_000
_POLL_S = 0.003
_MARKERS_EVERY_NS = _GOAL_STATE_EVERY_NS = 100_000_000
_REST_SPEED = 0.05
"""Joint speed up to which the arm is at rest, rad/s."""
OBSERVER, CONTROLLER = "observer", "controller"
_GAINS = "impedance"
"""Section of the controller's parameters that the planner reads, too: plans hold for these gains only."""


class PlannerNode(ManagedNode):
    """Passes goals, obstacles, contacts and joint states to the planner and publishes its plans."""

    NAME = NAME
    SECTIONS = PLANNER_SECTIONS
    CHANGEABLE = (SPEED_SCALE, *TOOL_PARAMETERS)

    def __init__(self) -> None:
        super().__init__()
        self._poses = self.make_publisher(topics.REFERENCE_POSE)
        self._postures = self.make_publisher(topics.REFERENCE_POSTURE)
        self._path = self.make_publisher(topics.PLAN_PATH)
        self._goal_states = self.make_publisher(topics.GOAL_STATE)
        self._marker_publisher = self.make_publisher(topics.PLAN_MARKERS)
        self._statistics = self.make_publisher(topics.PLAN_STATISTICS)
        self._solutions = self.make_publisher(topics.PLAN_SOLUTION)
        self._intake = self.log_intake(topics.PLANNER_INTAKE)
        self._lockstep = self.make_lockstep()
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self.inbox.add(topics.OBSTACLES, self._on_obstacles, serialized=True, largest=LARGEST_SCENE)
        self.inbox.add(topics.GOAL_POSE, self._on_goal)
        if self._lockstep.active:
            self.inbox.add(topics.LOCKSTEP_HORIZON, self._lockstep.hear, topics.EVERY)
        ready = self.turn_in(self._lockstep)
        self.inbox.add(topics.JOINT_STATES, self._on_state, self._lockstep.qos, serialized=True, ready=ready)
        settings: PlannerNodeSettings = self.settings[""]
        self._latency = LatencyEstimate(settings.latency_ns, fixed=self.lockstep)
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        self._budget = load_budget(settings.contact_budget).resolve(self.arm)
        gains = {_GAINS: ImpedanceSettings}
        self._gains = settings_of(self.ARGUMENTS, CONTROLLER, gains, self.arm)[_GAINS]
        self._core: RecedingHorizonPlanner | None = None
        self._take_arm(self.arm)
        self._not_ready = ""
        """Why no goal is taken; empty once there is a solver for the tool."""
        self._obstacle_reader = ObstacleMarkerReader(
            self.arm.base_frame,
            AssumedMaterial.of(settings),
        )
        self._frames = Frames(self, self.arm.base_frame)
        self._markers_due_ns = 0
        self._goals = 0
        self._goal_ns = 0
        """Stamp of the last goal that was taken."""
        self._published_goal: tuple[int, GoalPhase] | None = None
        self._goal_state_due_ns = 0
        self._late = 0
        self._detour = 0
        """Number of the detour that the arm is on; 0 for none."""
        self._solve_times = Histogram(bucket_us=100)
        self._rivalry = ""
        self.create_timer(LOOK_AROUND_S, self._look_around, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def configure(self) -> None:
        """Compile the solver."""
        self._planner.core = self._core = self._compile(self.arm)

    def _compile(self, arm: Arm) -> RecedingHorizonPlanner:
        settings, planning = self.settings[""], self.settings["planning"]
        if self.lockstep:
            # With a wall-clock deadline the result would depend on how busy the machine is.
            planning = dataclasses.replace(planning, deadline=0.0)
        core = RecedingHorizonPlanner(arm, planning, self._gains, self._budget.permitted_force, settings.max_spheres)
        began = time.monotonic()
        core.warm_up(lambda line: self.get_logger().info(line))
        self.get_logger().info(f"compiled in {time.monotonic() - began:.1f} s")
        return core

    def _take_arm(self, arm: Arm) -> None:
        """Plan for this arm, without a goal; what moves and stands around it will be heard again."""
        settings: PlannerNodeSettings = self.settings[""]
        stiffness = self.settings["planning"].contact_stiffness
        reaction = ContactReaction(arm, self.settings["unexpected_contact"], stiffness, settings.max_spheres > 0)
        self._planner = Planner(arm, None, reaction, settings, self._latency, self.refuse, self._gains.task)
        self._markers = PlanMarkers(arm, self._budget.permitted_force)

    def change_arm(self, arm: Arm) -> None:
        """Plan for an arm with another tool; goals are refused until the solver is compiled for it."""
        self.call_soon(lambda: self._part_with_tool(arm))
        if self._core is not None:
            threading.Thread(target=self._compile_for, args=[arm], name="compiler", daemon=True).start()

    def _part_with_tool(self, arm: Arm) -> None:
        state, goal = self._planner.state, self._planner.goal_state
        if self._not_ready:
            raise InputError(self._not_ready)
        if goal is not None and goal.phase.is_open:
            raise InputError("there is a goal; another tool needs the arm at rest: wait, or withdraw it with a stop")
        if state is not None and float(np.abs(state.v).max()) > _REST_SPEED:
            raise InputError(f"the arm moves with {np.abs(state.v).max():.3f} rad/s; another tool needs it at rest")
        self.note_call(Taken.TOOL)
        self._withdraw("the tool was changed")
        self._take_arm(arm)
        if self._core is not None:
            self._not_ready = "the solver is being compiled for another tool: no goal is taken before that"

    def _compile_for(self, arm: Arm) -> None:
        """Compile beside the loop, which hears meanwhile, and the executor, which answers."""
        try:
            core = self._compile(arm)
        except Exception as error:
            self.refuse("the tool", error)
            self._not_ready = f"there is no solver for this tool ({error}): no goal is taken; start the planner again"
            return

        def take() -> None:
            self._planner.core = self._core = core
            self._not_ready = ""

        self.inbox.post(take)

    def on_change(self) -> None:
        """Use another speed from the next plan on."""
        self._planner.speed_scale = self.settings[""].speed_scale

    def activate(self) -> None:
        """Wait for a goal."""
        self._withdraw("the planner was activated")

    def files(self) -> Mapping[str, Settings]:
        """The contact budget, and the controller's gains."""
        return {"budget": self._budget, _GAINS: self._gains}

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Plans, solve times and the terms of the last plan's cost."""
        values: dict[str, Any] = {
            "goals": self._goals,
            "late plans": self._late,
            **{f"solve {key} us": value for key, value in self._solve_times.summary().items()},
            "solve max us": self._solve_times.maximum_ns / 1000,
        }
        heard_by = commanders_that_hear(self, (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE))
        values["heard by"] = ", ".join(heard_by)
        planner, core = self._planner, self._core
        if self._rivalry or self._not_ready:
            return self._rivalry or self._not_ready, values
        if planner.state is None:
            return topics.WAITING_FOR_STATE, values
        plan = planner.plan
        if core is not None:
            values["candidates"] = core.candidates
        if plan is not None:
            values |= {
                "plan": plan.number,
                "solve ms": 1000 * plan.solve_s,
                "stop reason": plan.stop_reason,
                **plan_statistics(plan),
            }
            if core is not None and core.memory is not None:
                values["contact share"] = core.memory.approach.share
        now_ns, obstacles = planner.state.stamp_ns, planner.obstacles
        values |= {"spheres": len(obstacles.spheres), "obstacle age s": obstacles.age(now_ns)}
        problem = obstacles.problem(now_ns)
        if problem:
            return problem if obstacles.are_seen else topics.WAITING_FOR_OBSTACLES, values
        if planner.reaction.reason:
            return f"{planner.reaction.reaction}: {planner.reaction.reason}", values
        if planner.goal is not None:
            return "planning", values
        return "waiting for a goal" if heard_by else topics.WAITING_FOR_CONTROLLER, values

    def turn(self) -> None:
        """Handle what has arrived; `_on_state` plans when a plan is due."""
        if not self.lockstep:
            # States arrive much faster than plans are made; handling each would only take time from the loops.
            self._stop.wait(_POLL_S)
        self.inbox.wait(_IDLE_NS)

    def _on_state(self, data: bytes) -> None:
        planner = self._planner
        clock_ns = None if self.lockstep else self.inbox.handled_ns
        try:
            request = planner.request(self._reader.read(data), clock_ns)
            if request is not None:
                self._solve(request)
            self._report_goal()
        finally:
            # Also with one that was refused: others wait for it.
            self._lockstep.done(stamp_in(data))

    def _solve(self, request: Request) -> None:
        """Make the plan and publish it; why there is none is refused."""
        try:
            self._make_plan(request)
        except ContactReachError as error:
            self.refuse("plans", error)

    def _make_plan(self, request: Request) -> None:
        began_ns = time.monotonic_ns()
        plan = self._planner.solve(request)
        self._publish(plan)
        self._intake.outputs += 1
        took_ns = time.monotonic_ns() - began_ns
        self._solve_times.add(took_ns)
        self._latency.add(took_ns)
        self._late += took_ns > request.effect_ns - request.state_ns
        self._report_detour()
        self._publish_markers(plan)
        self._publish_record(plan, request.state_ns, took_ns)

    def _publish_record(self, plan: Plan, state_ns: int, took_ns: int) -> None:
        """Publish for bags how the plan was found, and what is needed to find it again."""
        core = self._core
        if core is None or core.memory is None:
            return
        values = {
            "plan": plan.number,
            "state ns": state_ns,
            # The planner has already counted this plan.
            "plans since reset": core.since_reset - 1,
            "stop reason": plan.stop_reason,
            "solve ms": 1000 * plan.solve_s,
            "took ms": took_ns / 1e6,
            **plan_statistics(plan),
            **({} if self._planner.goal is None else goal_values(self._planner.goal.position)),
            **self._planner.reaction.values(),
        }
        self._statistics.publish(to_statistics(plan, values, NAME, self.arm))
        self._solutions.publish(to_solution(solution_parts(plan, core.memory)))

    def _report_detour(self) -> None:
        """Log a detour that begins: the arm moves away from its goal."""
        memory = None if self._core is None else self._core.memory
        detour = None if memory is None else memory.detour
        number = current(detour)
        if detour is not None and number > self._detour:
            posture = np.round(detour.posture, 2).tolist()
            self.get_logger().info(f"goal {self._goals}: no progress; a detour leads to the posture {posture} rad")
        self._detour = number

    def _publish_markers(self, plan: Plan) -> None:
        if plan.effect_ns >= self._markers_due_ns:
            self._marker_publisher.publish(self._markers.show(plan))
            self._markers_due_ns = plan.effect_ns + _MARKERS_EVERY_NS

    def _publish(self, plan: Plan) -> None:
        poses, postures = to_references(plan, self.arm)
        self._poses.publish(poses)
        self._postures.publish(postures)
        self._path.publish(to_path(plan, self.arm))

    def _on_goal(self, message: PoseStamped) -> None:
        stamp_ns, before = nanoseconds(message.header.stamp), self._planner.goal_state
        try:
            if self._not_ready:
                raise InputError(self._not_ready)
            if self._frames.is_foreign(message.header):
                self._frames.publish_goal(message)
                return
            goal = to_goal(message, self.settings[""])
            self._planner.command(goal)
        except InputError as error:
            self._publish_goal(GoalState(GoalPhase.REFUSED, str(error)), stamp_ns)
            self._published_goal = None
            raise
        if before is not None and before.phase.is_open:
            replaced = before._replace(phase=GoalPhase.WITHDRAWN, reason="another goal has replaced it")
            self._publish_goal(replaced, self._goal_ns)
        self._goal_ns, self._published_goal = stamp_ns, None
        self._report_goal()
        if self._rivalry:
            why = f"{self._rivalry}: no goal is taken; end the others"
            self._withdraw_noted(why)
            raise InputError(why)
        self._goals += 1
        waiting = "; waiting for the first joint state" if self._planner.state is None else ""
        self.get_logger().info(f"goal {self._goals}: {np.round(np.asarray(goal.position), 3).tolist()} m{waiting}")

    def _report_goal(self) -> None:
        """Publish what happened to the goal when that changes, and on its way some times a second."""
        state = self._planner.goal_state
        if state is None:
            return
        now_ns = 0 if self._planner.state is None else self._planner.state.stamp_ns
        is_new = (self._goal_ns, state.phase) != self._published_goal
        # Also after the clock was set back.
        is_due = not 0 < self._goal_state_due_ns - now_ns <= _GOAL_STATE_EVERY_NS
        if is_new or (state.phase.is_open and is_due):
            self._published_goal, self._goal_state_due_ns = (self._goal_ns, state.phase), now_ns + _GOAL_STATE_EVERY_NS
            self._publish_goal(state, self._goal_ns)

    def _publish_goal(self, state: GoalState, stamp_ns: int) -> None:
        self._goal_states.publish(to_goal_state(state, stamp_ns, NAME, self.arm))

    def _on_obstacles(self, data: bytes) -> None:
        try:
            spheres = self._obstacle_reader.read(data)
        except FrameError:
            self._frames.publish_obstacles(decode(data, MarkerArray, topics.OBSTACLES.name))
        else:
            self._planner.see(spheres, self._obstacle_reader.stamp_ns)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        if self._planner.goal is None:
            return
        if is_stopped(message):
            why = f"{message.name} stopped the arm ({message.message})"
            self.get_logger().warning(f"goal withdrawn: {why}")
            self._withdraw(why)
        elif message.name == OBSERVER:
            self._on_contact(message)

    def _on_contact(self, message: DiagnosticStatus) -> None:
        """Take contact within the budget, or its absence, from the observer."""
        contact = read_contact(message, self.arm)
        reaction = self._planner.reaction
        known = reaction.reason
        if self._planner.touched(contact) and not known:
            self.get_logger().warning(f"{reaction.reaction}: {reaction.reason}")

    def _look_around(self) -> None:
        """Nothing is planned from what two arms report in turns; runs beside the loop, a few times a second."""
        self._rivalry = rivalry(self, (topics.JOINT_STATES, topics.SAFETY_STATE))
        if self._rivalry and self._planner.goal is not None:
            self.inbox.post(self._withdraw_for_rivals)

    def _withdraw_for_rivals(self) -> None:
        if self._planner.goal is None:
            return
        self.get_logger().warning(f"goal withdrawn: {self._rivalry}")
        self._withdraw_noted(self._rivalry)

    def _withdraw_noted(self, why: str) -> None:
        self.note_call(Taken.STOP)
        self._withdraw(why)

    def _withdraw(self, why: str) -> None:
        """Forget the goal: after a stop the arm moves again only with a new one."""
        if self._planner.plan is not None:
            self._marker_publisher.publish(self._markers.clear())
        self._planner.withdraw(why)
        self._report_goal()


def main() -> None:
    """Run the planner."""
    sys.exit(run(PlannerNode, Role.COMPUTING, sys.argv))


if __name__ == "__main__":
    main()
