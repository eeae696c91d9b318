"""The planner: when to plan, from which state and for which goal; a core computes the plans."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from contact_reach_ros.arm import Arm, JointState
from contact_reach_ros.arm.kinematics import POSITION
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import InputError, PlanningError, UnreachableError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.observer.observer import describe_contact
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalProgress, GoalState
from contact_reach_ros.planning.goal_stream import GoalStream
from contact_reach_ros.planning.plan import Plan, PlanningCore, Request
from contact_reach_ros.planning.settings import GIVE_WAY, ReplanningSettings, UnexpectedContactSettings
from contact_reach_ros.planning.unexpected_contact import Explanation
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import Target, Task
from contact_reach_ros.world.spheres import Spheres

GOAL_TIMEOUT = 2.0
"""Age beyond which a goal is refused, and gap in the joint states that ends the goal in force, s: nobody expects the
arm to move for either."""


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
        self._stamp_ns = math.inf

    def see(self, spheres: Spheres, stamp_ns: float) -> None:
        """Take the obstacles as they were at `stamp_ns`; infinity stands for the next `advance`."""
        self.spheres, self.are_seen, self._stamp_ns = spheres, True, stamp_ns

    def advance(self, now_ns: int) -> None:
        """Take note of the time: nothing was seen later than now, as a clock set back or another clock may say."""
        self._stamp_ns = min(self._stamp_ns, now_ns)

    def age(self, now_ns: int) -> float:
        """How old they are, s; NaN before they are seen."""
        return max(now_ns - self._stamp_ns, 0) / NANOSECONDS if self.are_seen else math.nan

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


PATIENCE_NS = NANOSECONDS // 100
"""Least duration of a contact that counts, ns: ten states, so that no single one ends a motion."""
_EARLY = 1.0
"""Time from a goal within which a contact may come from the arm's set-up rather than from its surroundings, s."""
_AT_THE_START = (
    ", or the observer does not know the arm's tool, or a filter of its measured torques (momentum.torque_cutoff, or "
    "KUKA's measured_torque_tau in robot_description: docs/adapter.md)"
)

_RECENT = 8
"""Plans whose times the latency of the next one is estimated from: on a busy machine they vary."""
_MAX_LATENCY_NS = NANOSECONDS // 4
_ATTEMPTS = 5
"""Plans for a new goal that are tried: each search starts with other candidates."""


class Planner:
    """Takes goals, obstacles, contacts and joint states, and requests plans when they are due.

    Planning has two phases, so that the slow one can run wherever there is time: `request` is cheap and decides when to
    plan, `solve` makes the plan.

    Attributes
    ----------
    goal
        Target of the goal in force as it was given; None while there is none, and always before the first joint state.
    plan
        The last plan; None before the first and after the goal was withdrawn.
    state
        The last joint state, which goals start from; None before the first.
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
        settings: ReplanningSettings,
        unexpected_contact: UnexpectedContactSettings,
        refuse: Callable[[str, InputError], None] | None = None,
        task: str = "",
        budget: ContactBudget | None = None,
    ) -> None:
        """Plan with `core`.

        Parameters
        ----------
        arm
            Arm to plan for.
        core
            Makes the plans; None for a planner that only makes requests.
        settings, unexpected_contact
            When to plan, and how to react to contact that no known obstacle explains.
        refuse
            Called for plans that are due while it is not known where the obstacles are; that error is raised by
            default.
        task
            What law (1) controls, see `ImpedanceSettings`, by default what the arm can hold; only so much of the
            orientation of goals counts.
        budget
            Of the observer; None for the default.
        """
        self.core = core
        self._task = task or arm.task
        self._explanation = (
            Explanation(arm, budget or ContactBudget()) if unexpected_contact.reaction == GIVE_WAY else None
        )
        self._unexpected_ns: int | None = None
        """Since when there has been a contact that nothing explains."""
        self.goal: Target | None = None
        self.plan: Plan | None = None
        self.state: JointState | None = None
        self.due_ns = 0
        self.speed_scale = settings.speed_scale
        self._arm = arm
        self._model = RobotModel(arm)
        self.settings = settings
        self._took_ns = deque([settings.latency_ns], _RECENT)
        self._busy_ns = 0
        """Time for which no state was taken since the last one, ns."""
        self._refuse = refuse
        self._stream = GoalStream()
        self._progress: GoalProgress | None = None
        self._failures = 0
        """Number of plans for the goal that were not found."""
        self.obstacles = KnownObstacles(settings.max_obstacle_age, settings.require_obstacles)

    def command(self, goal: Task, sent_ns: int = 0) -> bool:
        """Take a goal that was sent at `sent_ns`, as `start_of` has it; returns whether it goes on with a stream.

        Goals that follow each other soon and nearby are a stream: one goal that moves, see `GoalStream`.

        Raises
        ------
        InputError
            If it is too old, there is no joint state yet, the goal cannot be reached, see `Task.resolve` and
            `check_goal`, or the obstacles are unknown; the previous one stays.
        """
        state = self.start_of(sent_ns)
        target = self.resolve(goal, state)
        problem = self.obstacles.problem(state.stamp_ns)
        if problem:
            raise InputError(problem)
        self.goal = target
        # While a plan is made goals may be sent after the last state.
        is_known = 0 < sent_ns <= state.stamp_ns + NANOSECONDS
        goes_on = self._stream.take(target, sent_ns if is_known else state.stamp_ns)
        if goes_on and self._progress is not None:
            self._progress.go_on(goal)
        else:
            self._failures = 0
            self._progress = GoalProgress(goal)
        return goes_on

    def start_of(self, sent_ns: int = 0) -> JointState:
        """The joint state that a goal starts from: goals never wait for one, as the arm would move unexpectedly.

        `sent_ns` is on the clock of the joint states, ns; 0 stands for now, and so do times from the future, as another
        clock may give.

        Raises
        ------
        InputError
            If there is no joint state yet, or the goal is older than `GOAL_TIMEOUT`.
        """
        if self.state is None:
            raise InputError(
                "goal: there is no joint state yet; expected one, from which the arm starts: start the driver, wait "
                "until the planner reports 'waiting for a goal', and send the goal again"
            )
        age = (self.state.stamp_ns - sent_ns) / NANOSECONDS
        if sent_ns and age > GOAL_TIMEOUT:
            raise InputError(
                f"goal: its stamp is {age:.3f} s older than the last joint state; expected {GOAL_TIMEOUT:g} s at "
                "most: send it again with the present time, or with the stamp 0 for now; if it is new, let its "
                "sender's clock agree with the joint states'"
            )
        return self.state

    @property
    def has_goal(self) -> bool:
        """Whether a goal is in force."""
        return self.goal is not None

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
        self.goal = self.plan = self._unexpected_ns = None
        self._stream.end()
        if self.core is not None:
            self.core.reset()

    def see(self, obstacles: Spheres, stamp_ns: int | None = None) -> None:
        """Take all obstacles as they were at `stamp_ns`, on the clock of the joint states; None for now."""
        now_ns = math.inf if self.state is None else self.state.stamp_ns
        self.obstacles.see(obstacles, now_ns if stamp_ns is None else stamp_ns)

    def objection(self, contact: Contact | None) -> str:
        """Why the goal has to be withdrawn, if there is one: a contact that nothing explains, or one too strong.

        `contact` is the observer's. The caller withdraws the goal.
        """
        if self.goal is None or self.state is None or contact is None:
            self._unexpected_ns = None
            return ""
        if contact.is_excessive:
            return f"contact of {describe_contact(contact)}, more than the permitted force"
        if self._explanation is None:
            return ""
        found = self._explanation.unexpected(contact, self.state.q, self.obstacles.spheres)
        now_ns = self.state.stamp_ns
        if found is None:
            self._unexpected_ns = None
        elif self._unexpected_ns is None:
            self._unexpected_ns = now_ns
        elif now_ns - self._unexpected_ns >= PATIENCE_NS:
            is_early = self._progress is not None and self._progress.state.elapsed < _EARLY
            return f"unexpected contact of {describe_contact(found)}" + (_AT_THE_START if is_early else "")
        return ""

    def request(self, state: JointState) -> Request | None:
        """Take a joint state; returns what to plan from it, None while no plan is due.

        After a gap of more than `GOAL_TIMEOUT` in the states the goal is withdrawn: nobody expects the arm to go on.

        Raises
        ------
        InputError
            If the state is not finite; without `refuse`, also for what that takes note of.
        """
        stamp_ns, q, v, _ = state
        if not np.isfinite(q.sum() + v.sum()):
            raise InputError(f"joint_states: position and velocity must be finite, got {q.tolist()}, {v.tolist()}")
        # States that came while a plan was made, such as a search for a way, were not waited for.
        known_ns = stamp_ns if self.state is None else self.state.stamp_ns + self._busy_ns
        gap, self._busy_ns = (stamp_ns - known_ns) / NANOSECONDS, 0
        self.state = state
        self.obstacles.advance(stamp_ns)
        if self.goal is not None and gap > GOAL_TIMEOUT:
            self.withdraw(f"no joint state came for {gap:.1f} s, more than {GOAL_TIMEOUT:g} s; send the goal again")
        progress, model = self._progress, self._model
        if self.goal is None or progress is None:
            return None
        model.update(q, v)
        here, speed = self._stream.at(stamp_ns, stamp_ns), float(np.linalg.norm(model.twist[:3]))
        progress.update(here, model.position, model.rotation, speed, stamp_ns)
        if stamp_ns < self.due_ns:
            return None
        self.due_ns = stamp_ns + self.settings.period_ns
        problem = self.obstacles.problem(stamp_ns)
        if problem:
            if self._refuse is None:
                raise InputError(problem)
            self._refuse("plans", InputError(problem))
            return None
        effect_ns = stamp_ns + max(self.settings.latency_ns, min(max(self._took_ns), _MAX_LATENCY_NS))
        goal = self._stream.at(effect_ns, stamp_ns)
        rest = progress.rest if goal.rotation is None and self._task != POSITION else None
        spheres, scale = self.obstacles.spheres, self.speed_scale
        return Request(q, v, stamp_ns, effect_ns, goal, spheres, scale, holds=progress.holds, rest=rest)

    def solve(self, request: Request) -> Plan:
        """Make the plan that was requested.

        A goal for which there is none at the first `_ATTEMPTS`, or that proves unreachable, is refused.

        Raises
        ------
        InputError
            If no motion from this state has a finite cost.
        PlanningError
            If there is no way to the goal, or only one through a rigid body; or if the plan is for another speed.
        """
        if self.core is None:
            raise PlanningError("the planner has no core to make plans with: pass one to it")
        try:
            plan = self.core.plan(request)
        except (InputError, PlanningError) as error:
            self._failures += 1
            state = self.goal_state
            is_new = state is not None and state.phase is GoalPhase.ACCEPTED
            if isinstance(error, UnreachableError) or (is_new and self._failures >= _ATTEMPTS):
                self.withdraw(f"there is no plan for it: {error}", GoalPhase.REFUSED)
            raise
        if plan.speed_scale != request.speed_scale:
            raise PlanningError(
                f"the plan has speed_scale = {plan.speed_scale:g}: expected {request.speed_scale:g}, as requested; set "
                "speed_scale to 1 for a core that cannot plan for another"
            )
        self.plan = plan
        if self._progress is not None:
            self._progress.planned()
        return plan

    def took(self, duration_ns: int) -> None:
        """Take the time from a plan's request to its publication, ns: later ones take effect no earlier than that."""
        self._took_ns.append(duration_ns)
        self._busy_ns = duration_ns

    def resolve(self, goal: Task, state: JointState) -> Target:
        """The pose to plan for, without the part of the orientation that law (1) leaves to the null space.

        A goal that holds the orientation holds that of the goal in force, from which the arm may be turned, if any.

        Raises
        ------
        InputError
            If the goal cannot be reached, see `Task.resolve` and `check_goal`.
        """
        held = None if self.goal is None else self.goal.rotation
        target = goal.resolve(self._arm, self._model.tip_pose(state.q)[1] if held is None else held).of_task(self._task)
        check_goal(self._arm, target, self.obstacles.spheres.environment, state.q)
        return target
