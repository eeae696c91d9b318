"""The planner: when to plan, from which state and for which goal; a core computes the plans."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.settings import AXIS, POSE, POSITION
from contact_reach_ros.errors import InputError, PlanningError, is_missing_states
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.observer.observer import SafetyReport
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalProgress, GoalState
from contact_reach_ros.planning.plan import Plan, PlanningCore, Request
from contact_reach_ros.planning.settings import ReplanningSettings
from contact_reach_ros.planning.unexpected_contact import ContactReaction
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import Target, Task
from contact_reach_ros.world.spheres import Spheres


class KnownObstacles:
    """Obstacles that go stale.

    Attributes
    ----------
    spheres
        As they were seen last; none before.
    are_seen
        Whether they were seen at all.
    """

    def __init__(self, max_age: float, required: bool) -> None:
        """Before anything is seen, the scene counts as empty, unless obstacles are `required`.

        Parameters
        ----------
        max_age
            Age beyond which they are stale, s; 0 for none.
        required
            Whether nothing is known of the scene before they are seen.
        """
        self.spheres = Spheres.none()
        self.are_seen = False
        self._max_age = max_age
        self._required = required
        self._stamp_ns: int | None = None

    def see(self, spheres: Spheres, stamp_ns: int | None) -> None:
        """Take the obstacles as they were at `stamp_ns`; None stands for the next `advance`."""
        self.spheres, self.are_seen, self._stamp_ns = spheres, True, stamp_ns

    def advance(self, now_ns: int) -> None:
        """Take note of the time: nothing was seen later than now, as a clock set back or another clock may say."""
        if self._stamp_ns is None or self._stamp_ns > now_ns:
            self._stamp_ns = now_ns

    def age(self, now_ns: int) -> float:
        """How old they are, s; NaN before they are seen."""
        if not self.are_seen:
            return float("nan")
        return 0.0 if self._stamp_ns is None else max(now_ns - self._stamp_ns, 0) / NANOSECONDS

    def problem(self, now_ns: int) -> str:
        """Why nothing can be planned among them, and what to do about it; empty if it can."""
        if not self.are_seen:
            if not self._required:
                return ""
            return (
                "obstacles: none received yet; expected a message, empty where nothing is in the way: start what "
                "publishes them, or set require_obstacles to false for a scene without any"
            )
        age = self.age(now_ns)
        if not 0.0 < self._max_age < age:
            return ""
        return (
            f"obstacles: last seen {age:.3f} s ago; expected max_obstacle_age, {self._max_age:g} s, at most: see that "
            "what publishes them runs and its clock agrees with the joint states', or raise max_obstacle_age"
        )


_ABANDONED_NS = 2_000_000_000
"""Pause of the joint states, as of an emergency stop, after which the arm goes on only when somebody asks for it."""

_RECENT = 8
"""Plans whose times the estimate of the latency is made from."""
_MAX_LATENCY_NS = NANOSECONDS // 4


class Planner:
    """Takes goals, obstacles, contacts and joint states, and requests plans when they are due.

    Planning has two phases, so that the slow one can run wherever there is time: `request` is cheap and decides when to
    plan, `solve` makes the plan.

    Attributes
    ----------
    goal
        Target of the goal in force; None while there is none.
    plan
        The last plan; None before the first and after the goal was withdrawn.
    state
        The last joint state; None before the first.
    reaction
        Reaction to contact that no known obstacle explains.
    settings
        When to plan.
    obstacles
        What is known of the obstacles.
    due_ns
        Stamp of the earliest joint state that leads to the next plan, ns.
    speed_scale
        Share of γ that further plans use, 0 to 1; initially that of the settings.
    """

    def __init__(
        self,
        arm: Arm,
        core: PlanningCore | None,
        reaction: ContactReaction,
        settings: ReplanningSettings,
        latency: Callable[[], int] | None = None,
        refuse: Callable[[str, InputError], None] | None = None,
        task: str = POSE,
    ) -> None:
        """Plan with `core`.

        Parameters
        ----------
        arm, reaction, settings
            Arm, reaction to unexpected contact, and when to plan.
        core
            Makes the plans; None for a planner that only makes requests.
        latency
            Returns the time from a state to the effect of its plan, ns; by default that of the settings.
        refuse
            Called for a goal that waited for a joint state and proved unreachable, and for plans that are due while it
            is not known where the obstacles are, whose errors are raised by default; also for a goal that is withdrawn
            because the joint states paused.
        task
            What law (1) controls, see `ImpedanceSettings`; only so much of the orientation of goals counts.
        """
        self.core = core
        self._task = task
        self.reaction = reaction
        self.goal: Target | None = None
        self.plan: Plan | None = None
        self.state: JointState | None = None
        self.due_ns = 0
        self.speed_scale = settings.speed_scale
        self._clock_ns: int | None = None
        self._arm = arm
        self._model = RobotModel(arm)
        self.settings = settings
        self._latency = latency or (lambda: settings.latency_ns)
        self._refuse, self._note = refuse or _raise, refuse or _ignore
        self._pending: Task | None = None
        self._progress: GoalProgress | None = None
        self.obstacles = KnownObstacles(settings.max_obstacle_age, settings.require_obstacles)

    def command(self, goal: Task) -> None:
        """Take a goal. Before the first joint state it waits: the orientation may depend on the arm's pose.

        Raises
        ------
        InputError
            If the goal cannot be reached, see `Task.resolve` and `check_goal`, or the obstacles are unknown; the
            previous one stays.
        """
        if self.state is not None:
            target = self.resolve(goal, self.state)
            problem = self.obstacles.problem(self.state.stamp_ns)
            if problem:
                raise InputError(problem)
            self._pursue(target)
        else:
            self._pending = goal
        self._progress = GoalProgress(goal, self.settings.goal_timeout)

    @property
    def goal_state(self) -> GoalState | None:
        """What happened to the last goal that was taken; None before the first."""
        return None if self._progress is None else self._progress.state

    def withdraw(self, reason: str = "withdrawn", phase: GoalPhase = GoalPhase.WITHDRAWN) -> None:
        """Forget goal and plans: after a stop the arm moves again only with a new goal.

        `reason` and `phase` are what `goal_state` has from then on.
        """
        if self._progress is not None:
            self._progress.end(phase, reason)
        self.goal = self._pending = None
        self.plan = None
        self.reaction.reset()
        if self.core is not None:
            self.core.reset()

    def see(self, obstacles: Spheres, stamp_ns: int | None = None) -> None:
        """Take all obstacles as they were at `stamp_ns`, on the clock of the joint states; None for now."""
        now_ns = None if self.state is None else self.state.stamp_ns
        self.obstacles.see(obstacles, now_ns if stamp_ns is None else stamp_ns)

    def hear(self, report: SafetyReport) -> None:
        """Take a report of the observer: a stop withdraws the goal, unexpected contact changes what is planned.

        One that missed states is no stop: the controller decides about that.
        """
        if report.reason and not is_missing_states(report.reason):
            self.withdraw(f"the observer stopped the arm ({report.reason})")
        else:
            self.touched(report.contact)

    def touched(self, contact: Contact | None) -> bool:
        """Take the contact within the budget that the observer reports, None for none; returns whether plans change."""
        if self.goal is None or self.state is None:
            return False
        changes = self.reaction.report(contact, self.state.q, self.obstacles.spheres, self.state.stamp_ns)
        if changes:
            self.due_ns = self.state.stamp_ns
        if self._progress is not None and self.reaction.reason:
            self._progress.end(GoalPhase.WITHDRAWN, self.reaction.reason)
        return changes

    def request(self, state: JointState, clock_ns: int | None = None) -> Request | None:
        """Take a joint state; returns what to plan from it, None while no plan is due.

        `clock_ns`: when it came, on a clock that never jumps; its stamp where it is None.

        Raises
        ------
        InputError
            If the state is not finite; without `refuse`, also for what that takes note of.
        """
        stamp_ns, q, v, _ = state
        if not np.isfinite(q.sum() + v.sum()):
            raise InputError(f"joint_states: position and velocity must be finite, got {q.tolist()}, {v.tolist()}")
        clock_ns = stamp_ns if clock_ns is None else clock_ns
        paused_ns, self._clock_ns = clock_ns - (self._clock_ns or clock_ns), clock_ns
        if paused_ns > _ABANDONED_NS and self.goal is not None:
            why = f"joint states paused for {paused_ns / NANOSECONDS:.1f} s: send the goal again to go on"
            self.withdraw(why)
            self._note("goals", InputError(why))
        self.state = state
        self.obstacles.advance(stamp_ns)
        if self._pending is not None:
            pending, self._pending = self._pending, None
            try:
                self._pursue(self.resolve(pending, state))
            except InputError as error:
                self.withdraw(str(error), GoalPhase.REFUSED)
                self._refuse("goals", error)
        self._follow_progress(state)
        if self.goal is None or stamp_ns < self.due_ns:
            return None
        self.due_ns = stamp_ns + self.settings.period_ns
        self.reaction.moved(self._model.tip_pose(q)[0])
        problem = self.obstacles.problem(stamp_ns)
        if problem:
            self._refuse("plans", InputError(problem))
            return None
        goal, spheres = self.reaction.goal(self.goal), self.obstacles.spheres
        effect_ns, detours = stamp_ns + self._latency(), not self.reaction.is_retreating
        return Request(q, v, stamp_ns, effect_ns, goal, spheres, self.speed_scale, detours)

    def solve(self, request: Request) -> Plan:
        """Make the plan that was requested.

        Raises
        ------
        InputError
            If no motion from this state has a finite cost.
        PlanningError
            If there is no way to the goal, or only one through a rigid body; or if the plan is for another speed.
        """
        if self.core is None:
            raise PlanningError("the planner has no core to make plans with: pass one to it")
        plan = self.core.plan(request)
        if plan.speed_scale != request.speed_scale:
            raise PlanningError(
                f"the plan has speed_scale = {plan.speed_scale:g}: expected {request.speed_scale:g}, as requested; set "
                "speed_scale to 1 for a core that cannot plan for another"
            )
        self.plan = plan
        if self._progress is not None:
            self._progress.planned()
        return plan

    def _follow_progress(self, state: JointState) -> None:
        if self._progress is None or self.goal is None:
            return
        model = self._model
        model.update(state.q, state.v)
        speed = float(np.linalg.norm(model.twist[:3]))
        if self._progress.update(self.goal, model.position, model.rotation, speed, state.stamp_ns):
            self.withdraw()
            self._note("goals", InputError(f"{self._progress.state.reason}: the goal is withdrawn"))

    def resolve(self, goal: Task, state: JointState) -> Target:
        """The pose to plan for, without what of the orientation law (1) leaves to the null space.

        Raises
        ------
        InputError
            If the goal cannot be reached, see `Task.resolve` and `check_goal`.
        """
        target = goal.resolve(self._arm, self._model.tip_pose(state.q)[1])
        if self._task == POSITION:
            target = Target(target.position)
        elif self._task == AXIS:
            target = dataclasses.replace(target, only_axis=target.rotation is not None)
        check_goal(self._arm, target, self.obstacles.spheres.environment, state.q)
        return target

    def _pursue(self, goal: Target) -> None:
        self.goal = goal
        self.reaction.reset()


class LatencyEstimate:
    """Time until a plan begun now can take effect: as long as the last ones took, which varies on a busy machine.

    Parameters
    ----------
    least_ns
        Shortest estimate, ns.
    """

    def __init__(self, least_ns: int) -> None:
        self._least_ns = least_ns
        self._recent_ns: deque[int] = deque(maxlen=_RECENT)

    def add(self, took_ns: int) -> None:
        """Take the time from a plan's request to its publication, ns."""
        self._recent_ns.append(took_ns)

    def __call__(self) -> int:
        """The estimate, ns."""
        return max(self._least_ns, min(max(self._recent_ns, default=0), _MAX_LATENCY_NS))


def _ignore(*_: object) -> None:
    pass


def _raise(_: str, error: InputError) -> None:
    raise error
