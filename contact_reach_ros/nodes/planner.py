"""The planner: goals in, paired references out, re-planned continuously.

The loop thread is the worker that solves; the executor meanwhile serves services in a thread of its own.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.control.settings import ImpedanceSettings, SupervisionSettings
from contact_reach_ros.errors import ContactReachError, FrameError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial, ObstacleMarkerReader
from contact_reach_ros.messages.plan_messages import to_markers, to_path, to_references, to_request, to_statistics
from contact_reach_ros.messages.plan_request import request_parts
from contact_reach_ros.messages.safety_state import is_stopped, read_contact
from contact_reach_ros.messages.serialized import JointStateReader, decode
from contact_reach_ros.messages.values import goal_values, nanoseconds, quaternion, vector
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.planner import LatencyEstimate, Planner
from contact_reach_ros.planning.receding_horizon import Memory, RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PLANNER_SECTIONS, SPEED_SCALE, PlannerNodeSettings
from contact_reach_ros.planning.unexpected_contact import ContactReaction
from contact_reach_ros.ros.frames import Frames
from contact_reach_ros.ros.graph import commanders_that_hear
from contact_reach_ros.ros.inbox import LARGEST_SCENE
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import run
from contact_reach_ros.settings import Sections, Settings
from contact_reach_ros.timing import Histogram
from contact_reach_ros.world.goal import POSE, Goal

_POLL_NS = 3_000_000
_SHOWN_EVERY_NS = 100_000_000
"""Period of markers and goal states."""
_PUBLISHED = (
    *(topics.REFERENCE_POSE, topics.REFERENCE_POSTURE, topics.GOAL_STATE),
    *(topics.PLAN_PATH, topics.PLAN_MARKERS, topics.PLAN_STATISTICS, topics.PLAN_REQUEST),
)
OBSERVER, CONTROLLER = "observer", "controller"
_GAINS, _SUPERVISION = "impedance", "supervision"
"""Sections of the controller's parameters that the planner reads, too: plans hold for these only."""


class PlannerNode(ManagedNode):
    """Passes goals, obstacles, contacts and joint states to the planner and publishes its plans."""

    NAME = "planner"
    SECTIONS = PLANNER_SECTIONS
    CHANGEABLE = (SPEED_SCALE,)

    def __init__(self) -> None:
        super().__init__()
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self.inbox.add(topics.OBSTACLES, self._on_obstacles, serialized=True, largest=LARGEST_SCENE)
        self.inbox.add(topics.GOAL_POSE, self._on_goal)
        # States arrive much faster than plans are made; handling each would only take time from the loops.
        self.follow(topics.JOINT_STATES, self._on_state, hurried=False)
        settings: PlannerNodeSettings = self.settings[""]
        self._latency = LatencyEstimate(settings.latency_ns)
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        self._budget = load_budget(settings.contact_budget).resolve(self.arm)
        sections: Sections = {_GAINS: ImpedanceSettings, _SUPERVISION: SupervisionSettings}
        self._controllers = settings_of(self.ARGUMENTS, CONTROLLER, sections, self.arm)
        self._core: RecedingHorizonPlanner
        """Made by `configure`."""
        reaction = ContactReaction(self.arm, self.settings["unexpected_contact"])
        self._planner = Planner(
            self.arm, None, reaction, settings, self._latency, self.refuse, self._controllers[_GAINS].task
        )
        self._outputs = {topic: self.make_publisher(topic) for topic in _PUBLISHED}
        self._markers_due_ns = self._goal_state_due_ns = 0
        self._reported: tuple[int, GoalPhase] | None = None
        """Stamp and phase of the goal that was published last."""
        self._obstacle_reader = ObstacleMarkerReader(self.arm.base_frame, AssumedMaterial.of(settings))
        self._frames = Frames(self, self.arm.base_frame)
        self._goals = self._goal_ns = 0
        """Number of goals that were taken, and the stamp of the last one."""
        self._seen_ns = 0
        """When the obstacles were sent, ns since the epoch."""
        self._late = self._detour = 0
        """Number of late plans, and of the detour that the arm is on; 0 for none."""
        self._solve_times = Histogram()
        # Nothing is planned from what two arms report in turns.
        self.exclude([topics.JOINT_STATES, topics.SAFETY_STATE])

    def configure(self) -> None:
        """Compile the solver."""
        core = RecedingHorizonPlanner(
            self.arm,
            self.settings["planning"],
            self._controllers[_GAINS],
            self._budget.permitted_force,
            self.settings[""].max_spheres,
            self._controllers[_SUPERVISION].max_position_error,
        )
        core.warm_up(lambda line: self.get_logger().info(line))
        self._planner.core = self._core = core

    def on_change(self) -> None:
        """Use another speed from the next plan on."""
        self._planner.speed_scale = self.settings[""].speed_scale

    def activate(self) -> None:
        """Wait for a goal."""
        self._withdraw("the planner was activated")

    def files(self) -> Mapping[str, Settings]:
        """The contact budget, and the controller's settings that plans depend on."""
        return {"budget": self._budget, **self._controllers}

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Goals, solve times, obstacles, and what the planner waits for; `plan/statistics` has the plans."""
        heard_by = commanders_that_hear(self, (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE))
        values: dict[str, Any] = {
            "heard by": ", ".join(heard_by),
            "goals": self._goals,
            "late plans": self._late,
            **{f"solve {key} us": value for key, value in self._solve_times.summary().items()},
            "solve max us": self._solve_times.maximum_ns / 1000,
        }
        planner = self._planner
        if self.rivals or planner.state is None:
            return self.rivals or topics.WAITING_FOR_STATE, values
        now_ns, obstacles = planner.state.stamp_ns, planner.obstacles
        values |= {"spheres": len(obstacles.spheres), "obstacle age s": obstacles.age(now_ns)}
        problem = obstacles.problem(now_ns)
        if problem:
            return problem if obstacles.are_seen else topics.WAITING_FOR_OBSTACLES, values
        if planner.reaction.reason or planner.goal is not None:
            return planner.reaction.reason or "planning", values
        return "waiting for a goal" if heard_by else topics.WAITING_FOR_CONTROLLER, values

    def turn(self) -> None:
        """Handle what has arrived; `_on_state` plans when a plan is due."""
        self.inbox.wait(_POLL_NS)

    def _on_state(self, data: bytes) -> None:
        request = self._planner.request(self._reader.read(data), self.arrived_ns)
        if request is not None:
            try:
                self._make_plan(request)
            except ContactReachError as error:
                self.refuse("plans", error)
        self._follow_goal()

    def _make_plan(self, request: Request) -> None:
        began_ns, now_ns = time.monotonic_ns(), self.now_ns
        start = self._core.memory
        plan = self._planner.solve(request)
        poses, postures = to_references(plan, self.arm)
        self._publish(topics.REFERENCE_POSE, poses)
        self._publish(topics.REFERENCE_POSTURE, postures)
        self._publish(topics.PLAN_PATH, to_path(plan, self.arm))
        took_ns = time.monotonic_ns() - began_ns
        self._solve_times.add(took_ns)
        # Simulated time stands still while a plan is made.
        passed_ns = self.now_ns - now_ns
        self._latency.add(passed_ns)
        self._late += passed_ns > request.effect_ns - request.state_ns
        if plan.effect_ns >= self._markers_due_ns:
            self._publish(topics.PLAN_MARKERS, to_markers(plan, self.arm))
            self._markers_due_ns = plan.effect_ns + _SHOWN_EVERY_NS
        found = self._core.memory
        if found is not None:
            self._record(plan, request, start, found, took_ns)

    def _record(self, plan: Plan, request: Request, start: Memory | None, found: Memory, took_ns: int) -> None:
        """Publish for bags how a plan was found, and what is needed to solve it again.

        `start` and `found` are what the solver knew before, None after a reset, and knows now.
        """
        detour, number = found.request.detour, found.request.on_detour
        if detour is not None and number > self._detour:
            posture = np.round(detour.posture, 2).tolist()
            self.get_logger().info(f"goal {self._goals}: no progress; a detour leads to the posture {posture} rad")
        self._detour = number
        goal = self._planner.goal
        values = {
            "plan": plan.number,
            "state ns": request.state_ns,
            "plans since reset": found.plans - 1,
            "stop reason": plan.stop_reason,
            "solve ms": 1000 * plan.solve_s,
            **plan.statistics(),
            "obstacles sent ns": self._seen_ns,
            "took ms": took_ns / 1e6,
            "contact share": found.approach.share,
            **self._planner.reaction.values(),
            **({} if goal is None else goal_values(goal.position)),
        }
        self._publish(topics.PLAN_STATISTICS, to_statistics(plan, values, self.NAME, self.arm))
        # The core has already counted this plan; an arm that jumped made it forget what it had.
        start = start if found.plans > 1 else None
        self._publish(topics.PLAN_REQUEST, to_request(request_parts(plan.number, request, start, found.best)))

    def _report_goal(self, state: GoalState, stamp_ns: int) -> None:
        """Publish what happened to a goal that was sent at `stamp_ns`."""
        self._reported = None
        self._publish(topics.GOAL_STATE, to_goal_state(state, stamp_ns, self.NAME, self.arm))

    def _follow_goal(self) -> None:
        """Publish what happened to the goal when that changes; on its way some times a second."""
        state, now_ns = self._planner.goal_state, 0 if self._planner.state is None else self._planner.state.stamp_ns
        if state is None:
            return
        phase = (self._goal_ns, state.phase)
        # Also after the clock was set back.
        is_due = not 0 < self._goal_state_due_ns - now_ns <= _SHOWN_EVERY_NS
        if phase != self._reported or (state.phase.is_open and is_due):
            self._report_goal(state, self._goal_ns)
            self._reported, self._goal_state_due_ns = phase, now_ns + _SHOWN_EVERY_NS

    def _publish(self, topic: topics.Topic, message: Any) -> None:
        self._outputs[topic].publish(message)

    def _on_goal(self, message: PoseStamped) -> None:
        stamp_ns, before = nanoseconds(message.header.stamp), self._planner.goal_state
        try:
            if self._frames.is_foreign(message.header):
                return self._frames.publish_goal(message)
            pose, kept = message.pose, self.settings[""].goal_orientation
            orientation = quaternion(pose.orientation) if kept == POSE else kept
            frame = message.header.frame_id
            goal = Goal(vector(pose.position), orientation, frame=frame)
            self._planner.command(goal)
        except InputError as error:
            self._report_goal(GoalState(GoalPhase.REFUSED, str(error)), stamp_ns)
            raise
        if before is not None and before.phase.is_open:
            replaced = before._replace(phase=GoalPhase.WITHDRAWN, reason="another goal has replaced it")
            self._report_goal(replaced, self._goal_ns)
        self._goal_ns = stamp_ns
        self._follow_goal()
        if self.rivals:
            why = f"{self.rivals}: no goal is taken; end the others"
            self._withdraw(why)
            raise InputError(why)
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
        if is_stopped(message):
            self._give_up(f"{message.name} stopped the arm ({message.message})")
        elif message.name == OBSERVER and self._planner.goal is not None:
            reaction = self._planner.reaction
            known = reaction.reason
            if self._planner.touched(read_contact(message, self.arm)) and not known:
                self.get_logger().warning(reaction.reason)

    def on_rivals(self) -> None:
        """Withdraw the goal."""
        self.inbox.post(lambda: self._give_up(self.rivals))

    def _give_up(self, why: str) -> None:
        """Forget the goal, if there is one, with a line in the log."""
        if self._planner.goal is not None:
            self.get_logger().warning(f"goal withdrawn: {why}")
            self._withdraw(why)

    def _withdraw(self, why: str) -> None:
        """Forget the goal: after a stop the arm moves again only with a new one."""
        if self._planner.plan is not None:
            self._publish(topics.PLAN_MARKERS, to_markers(None, self.arm))
        self._planner.withdraw(why)
        self._follow_goal()


if __name__ == "__main__":
    sys.exit(run(PlannerNode, sys.argv))
