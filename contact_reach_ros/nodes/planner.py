"""The planner: goals in, paired references out, re-planned continuously.

The loop thread is the worker that solves; the executor meanwhile serves services in a thread of its own.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.bags.goals import goal_values
from contact_reach_ros.control.settings import ImpedanceSettings, SupervisionSettings
from contact_reach_ros.errors import ContactReachError, FrameError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.cdr import stamp_in
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.goals import to_goal
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial, ObstacleMarkerReader
from contact_reach_ros.messages.plan_messages import PlanMarkers, to_path, to_references, to_request, to_statistics
from contact_reach_ros.messages.plan_request import request_parts
from contact_reach_ros.messages.safety_state import is_stopped, read_contact
from contact_reach_ros.messages.serialization import decode
from contact_reach_ros.messages.serialized import JointStateReader
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.planner import LatencyEstimate, Planner
from contact_reach_ros.planning.receding_horizon import Memory, RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PLANNER_SECTIONS, SPEED_SCALE, PlannerNodeSettings
from contact_reach_ros.planning.unexpected_contact import ContactReaction
from contact_reach_ros.ros.frames import Frames
from contact_reach_ros.ros.graph import LOOK_AROUND_S, commanders_that_hear, rivalry
from contact_reach_ros.ros.inbox import LARGEST_SCENE
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import run
from contact_reach_ros.ros.scheduling import Role
from contact_reach_ros.settings import Sections, Settings
from contact_reach_ros.timing import Histogram

NAME = "planner"

_IDLE_NS = 100_000_000
_POLL_S = 0.003
_MARKERS_EVERY_NS = _GOAL_STATE_EVERY_NS = 100_000_000
OBSERVER, CONTROLLER = "observer", "controller"
_GAINS, _SUPERVISION = "impedance", "supervision"
"""Sections of the controller's parameters that the planner reads, too: plans hold for these only."""


class PlannerNode(ManagedNode):
    """Passes goals, obstacles, contacts and joint states to the planner and publishes its plans."""

    NAME = NAME
    SECTIONS = PLANNER_SECTIONS
    CHANGEABLE = (SPEED_SCALE,)

    def __init__(self) -> None:
        super().__init__()
        self._poses = self.make_publisher(topics.REFERENCE_POSE)
        self._postures = self.make_publisher(topics.REFERENCE_POSTURE)
        self._path = self.make_publisher(topics.PLAN_PATH)
        self._goal_states = self.make_publisher(topics.GOAL_STATE)
        self._marker_publisher = self.make_publisher(topics.PLAN_MARKERS)
        self._statistics = self.make_publisher(topics.PLAN_STATISTICS)
        self._requests = self.make_publisher(topics.PLAN_REQUEST)
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
        sections: Sections = {_GAINS: ImpedanceSettings, _SUPERVISION: SupervisionSettings}
        controllers = settings_of(self.ARGUMENTS, CONTROLLER, sections, self.arm)
        self._gains: ImpedanceSettings = controllers[_GAINS]
        self._supervision: SupervisionSettings = controllers[_SUPERVISION]
        self._core: RecedingHorizonPlanner | None = None
        reaction = ContactReaction(self.arm, self.settings["unexpected_contact"])
        self._planner = Planner(self.arm, None, reaction, settings, self._latency, self.refuse, self._gains.task)
        self._markers = PlanMarkers(self.arm, self._budget.permitted_force)
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
        self._seen_ns = 0
        """When the obstacles were sent, ns since the epoch."""
        self._late = 0
        self._detour = 0
        """Number of the detour that the arm is on; 0 for none."""
        self._solve_times = Histogram()
        self._rivalry = ""
        self.every(LOOK_AROUND_S, self._look_around)

    def configure(self) -> None:
        """Compile the solver."""
        settings, planning = self.settings[""], self.settings["planning"]
        if self.lockstep:
            # With a wall-clock deadline the result would depend on how busy the machine is.
            planning = dataclasses.replace(planning, deadline=0.0)
        core = RecedingHorizonPlanner(
            self.arm,
            planning,
            self._gains,
            self._budget.permitted_force,
            settings.max_spheres,
            self._supervision.max_position_error,
        )
        began = time.monotonic()
        core.warm_up(lambda line: self.get_logger().info(line))
        self.get_logger().info(f"compiled in {time.monotonic() - began:.1f} s")
        self._planner.core = self._core = core

    def on_change(self) -> None:
        """Use another speed from the next plan on."""
        self._planner.speed_scale = self.settings[""].speed_scale

    def activate(self) -> None:
        """Wait for a goal."""
        self._withdraw("the planner was activated")

    def files(self) -> Mapping[str, Settings]:
        """The contact budget, and the controller's settings that plans depend on."""
        return {"budget": self._budget, _GAINS: self._gains, _SUPERVISION: self._supervision}

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
        if self._rivalry:
            return self._rivalry, values
        if planner.state is None:
            return topics.WAITING_FOR_STATE, values
        plan = planner.plan
        if plan is not None:
            values |= {
                "plan": plan.number,
                "solve ms": 1000 * plan.solve_s,
                "stop reason": plan.stop_reason,
                **plan.statistics(),
            }
            if core is not None and core.memory is not None:
                values["contact share"] = core.memory.approach.share
        now_ns, obstacles = planner.state.stamp_ns, planner.obstacles
        values |= {"spheres": len(obstacles.spheres), "obstacle age s": obstacles.age(now_ns)}
        problem = obstacles.problem(now_ns)
        if problem:
            return problem if obstacles.are_seen else topics.WAITING_FOR_OBSTACLES, values
        if planner.reaction.reason:
            return planner.reaction.reason, values
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
        """Make and publish the plan; a failure is counted and logged."""
        try:
            self._make_plan(request)
        except ContactReachError as error:
            self.refuse("plans", error)

    def _make_plan(self, request: Request) -> None:
        began_ns = time.monotonic_ns()
        memory = None if self._core is None else self._core.memory
        plan = self._planner.solve(request)
        self._publish(plan)
        took_ns = time.monotonic_ns() - began_ns
        self._solve_times.add(took_ns)
        self._latency.add(took_ns)
        self._late += took_ns > request.effect_ns - request.state_ns
        self._report_detour()
        self._publish_markers(plan)
        self._publish_record(plan, request, memory, took_ns)

    def _publish_record(self, plan: Plan, request: Request, memory: Memory | None, took_ns: int) -> None:
        """Publish for bags how the plan was found, and what is needed to solve it again."""
        core = self._core
        if core is None or core.memory is None:
            return
        # The planner has already counted this plan.
        since_reset = core.memory.plans - 1
        values = {
            "plan": plan.number,
            "state ns": request.state_ns,
            "obstacles sent ns": self._seen_ns,
            "plans since reset": since_reset,
            "stop reason": plan.stop_reason,
            "solve ms": 1000 * plan.solve_s,
            "took ms": took_ns / 1e6,
            **plan.statistics(),
            **({} if self._planner.goal is None else goal_values(self._planner.goal.position)),
            **self._planner.reaction.values(),
        }
        self._statistics.publish(to_statistics(plan, values, NAME, self.arm))
        # An arm that jumped made the planner forget what it had.
        start = memory if since_reset else None
        self._requests.publish(to_request(request_parts(plan.number, request, start, core.memory.best)))

    def _report_detour(self) -> None:
        """Log a detour that begins: the arm moves away from its goal."""
        memory = None if self._core is None else self._core.memory
        number, detour = (0, None) if memory is None else (memory.request.on_detour, memory.request.detour)
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
            self._withdraw(why)
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
            self._seen_ns = self.inbox.sent_ns

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
            self.get_logger().warning(reaction.reason)

    def _look_around(self) -> None:
        """Nothing is planned from what two arms report in turns; runs beside the loop, a few times a second."""
        self._rivalry = rivalry(self, (topics.JOINT_STATES, topics.SAFETY_STATE))
        if self._rivalry and self._planner.goal is not None:
            self.inbox.post(self._withdraw_for_rivals)

    def _withdraw_for_rivals(self) -> None:
        if self._planner.goal is None:
            return
        self.get_logger().warning(f"goal withdrawn: {self._rivalry}")
        self._withdraw(self._rivalry)

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
