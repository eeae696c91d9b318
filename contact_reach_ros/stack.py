"""The whole stack without ROS: observer, planner and controller around one robot."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from contact_reach_ros.agreement import OF_PLANS, differences, plan_basis
from contact_reach_ros.arm import BLIND_AFTER, Arm, Array, JointState, link_frames
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.control.supervisor import RESET_ORDER
from contact_reach_ros.errors import InputError, PlanningError, SettingsError, requested
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer, SafetyReport
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.planning.goal_progress import GoalPhase
from contact_reach_ros.planning.plan import Plan, PlanningCore, Request
from contact_reach_ros.planning.planner import Planner, ReplanningSettings
from contact_reach_ros.planning.settings import PlanningSettings, UnexpectedContactSettings
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.timing import NANOSECONDS, PERIOD
from contact_reach_ros.world.goal import Target, Task
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, sphere_capacity

if TYPE_CHECKING:
    from contact_reach_ros.planning.solver.solver import CostFunction, FloatArray, Solver

_log = logging.getLogger(__name__)


class Robot(Protocol):
    """A robot, simulated or real, that the stack steps."""

    @property
    def stop_reason(self) -> str:
        """Why the robot itself stopped the arm; empty if it did not."""

    def command(self, torque: Array, clock_ns: int) -> None:
        """Take a command (n,), N m; raises `InputError` if it is refused."""

    def step(self, clock_ns: int) -> None:
        """Advance by one period."""

    def read(self) -> Sequence[JointState]:
        """The joint states that have arrived since the last call, in their order."""

    def obstacles(self) -> Spheres | None:
        """Present obstacles; None when there is nothing new."""

    def reset(self) -> None:
        """Release a stop of its own, if there is one; raises `InputError` if that is not possible."""

    def contact_forces(self) -> Array | None:
        """Contact force on each of the arm's contact links, N; None where it is unknown, as on a real robot."""


class Tick(NamedTuple):
    """What happened in one step."""

    state: JointState
    """The last usable joint state."""
    torque: Array | None
    """The last command (n,), N m; None if there was none in this step."""
    report: SafetyReport | None
    """The observer's report on the last joint state; None if that state was not new."""
    plan: Plan | None
    """The plan made in this step, if any."""


class Result(NamedTuple):
    """How a run ended."""

    reached: bool
    """Whether the goal was reached and nothing stopped the arm."""
    duration: float
    """Time from the goal until it was first reached, s; NaN if it was not."""
    distance: float
    """Distance of the tip from the goal at the end, m."""
    max_contact_force: float
    """Largest contact force on one link, N; NaN if the robot does not report it."""
    stop_reason: str
    """Why the arm was stopped, or why there is no plan; empty otherwise."""
    plans: int
    """Number of plans made."""
    settled: bool = False
    """Whether the tip had stayed at the goal, at rest, by the end of the run."""


class Stack:
    """Observer, planner and controller with a robot, stepped together in simulated time.

    With the scene as the only argument, everything is set up as in the nodes in simulated time.

    Attributes
    ----------
    arm, scene
        Arm and scene that the stack was built for.
    observer, controller, planner, robot
        Its parts; each can be used by itself.
    state
        The last usable joint state.
    refused
        Number of refused inputs, by kind.
    failure
        Why the last plan was not found; empty if it was.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        planning: PlanningSettings | None = None,
        replanning: ReplanningSettings | None = None,
        controller: ControllerSettings | Controller | None = None,
        observer: ObserverSettings | Observer | None = None,
        unexpected_contact: UnexpectedContactSettings | None = None,
        budget: ContactBudget | None = None,
        planner: PlanningCore | Planner | None = None,
        robot: Robot | None = None,
        seed: int = 0,
        period: float = PERIOD,
    ) -> None:
        """Put the stack together; nothing is compiled before the first plan.

        Parameters
        ----------
        scene
            Scene with target, start and obstacles; it also names the arm.
        planning, replanning, controller, observer, unexpected_contact, budget
            Settings; None for the defaults. The deadline of plans is ignored: results must not depend on how fast the
            machine is. In a scene without obstacles a robot need not report any. `controller` and `observer` can also
            be your own objects; beside an observer of your own the controller does not watch itself.
        planner
            Your own planner, not shared with another stack, or a core that makes plans, which is reset first. It keeps
            its own seed and deadline.
        robot
            Replaces the simulated robot.
        seed
            Seed of the solver's candidates and the sensor noise.
        period
            Time between joint states, s.

        Raises
        ------
        SettingsError
            If the seed is no integer from 0 on, the simulated robot cannot have the period, settings are given beside a
            planner that has its own, or planner and controller have different gains.
        InputError
            If the robot has no joint state at the start.
        """
        if isinstance(planner, Planner) and (planning or replanning or unexpected_contact):
            raise SettingsError("planner is a Planner with settings of its own; expected no others beside it")
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise SettingsError(f"seed = {seed!r}: expected an integer from 0 on")
        self.scene = scene
        self.arm: Arm = scene.arm
        budget = (budget or ContactBudget()).resolve(self.arm)
        planning = dataclasses.replace(planning or PlanningSettings(), deadline=0.0)
        replanning = replanning or ReplanningSettings()
        if not scene.obstacles:
            replanning = dataclasses.replace(replanning, require_obstacles=False)
        self.robot: Robot = SimulatedRobot(scene, noise_seed=seed, period=period) if robot is None else robot
        if isinstance(controller, Controller):
            self.controller = controller
        else:
            self.controller = Controller(
                self.arm, controller or ControllerSettings(), period, hold=budget.handover_thresholds
            )
        if isinstance(observer, Observer):
            self.observer = observer
        else:
            observer = observer or ObserverSettings()
            self.observer = Observer(self.arm, observer, budget, period)
            watcher = Observer(self.arm, observer, budget, period, locates=False, blind_after=BLIND_AFTER)
            self.controller.watch_with(watcher)
        if isinstance(planner, Planner):
            self.planner = planner
        elif planner is not None:
            planner.reset()
            unexpected_contact = unexpected_contact or UnexpectedContactSettings()
            task = self.controller.settings.impedance.task
            self.planner = Planner(self.arm, planner, replanning, unexpected_contact, task=task, budget=budget)
        else:
            self.planner = make_planner(
                self.arm,
                sphere_capacity(scene),
                planning=planning,
                replanning=replanning,
                controller=self.controller.settings,
                budget=budget,
                unexpected_contact=unexpected_contact,
            )
            self._core().reseed(seed)
        basis = getattr(self.planner.core, "basis", {})
        own = plan_basis(self.arm, self.controller.settings)
        differs = differences(own, basis, "planner", OF_PLANS)
        if differs:
            raise SettingsError(f"planner and controller disagree: {differs}; give both the same")
        self.refused: dict[str, int] = {}
        self.failure = ""
        self._period_ns = round(period * NANOSECONDS)
        self._clock_ns = 0
        self._steps = 0
        self._seen_ns = 0
        """When the observer's last new state came."""
        self._is_warm = False
        self._arrived = list(self.robot.read())
        if not self._arrived:
            raise InputError("robot: read() returned no joint state; expected one from the start")
        self.state = self.planner.state = self._arrived[-1]
        self._look()

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped; empty while it is not."""
        return self.controller.stop_reason or self.robot.stop_reason

    @property
    def tip_position(self) -> Array:
        """Measured position of the tip, (3,), m, base frame."""
        return link_frames(self.arm, self.state.q)[1][-1]

    def warm_up(self) -> None:
        """Compile what the first plan would otherwise wait for: up to a minute the first time, then seconds."""
        if not self._is_warm:
            self._core().warm_up(_log.info)
            self._is_warm = True

    def plan(self, goal: Task) -> Plan:
        """Make one plan for a goal from the present state, without changing the stack.

        Raises
        ------
        InputError
            If the goal cannot be reached, or it is not known where the obstacles are.
        """
        target = self._resolve(goal)
        problem = self.planner.obstacles.problem(self.state.stamp_ns)
        if problem:
            raise InputError(problem)
        self.warm_up()
        core, state = self._core(), self.state
        memory = core.memory
        try:
            core.reset()
            effect_ns, spheres = state.stamp_ns + self.planner.settings.latency_ns, self.planner.obstacles.spheres
            scale = self.planner.speed_scale
            return core.plan(Request(state.q, state.v, state.stamp_ns, effect_ns, target, spheres, scale))
        finally:
            core.memory = memory

    def step(self) -> Tick:
        """Control, observe and plan from the joint states that have arrived, then advance the robot by one period."""
        torque = self._control()
        report = self._observe()
        plan = self._plan()
        self.robot.step(self._clock_ns)
        self._steps += 1
        self._clock_ns = self._steps * self._period_ns
        self._arrived = list(self.robot.read())
        for state in self._arrived:
            if np.isfinite(state.q.sum() + state.v.sum()):
                self.state = state
        return Tick(self.state, torque, report, plan)

    def settle(self, duration: float = 0.8) -> None:
        """Step for `duration` s; the default lets the arm be handed over and the controller reach full authority."""
        while self._clock_ns < round(duration * NANOSECONDS):
            self.step()

    def command(self, goal: Task) -> None:
        """Give a goal, or replace the current one; raises `InputError` if it cannot be reached."""
        self._resolve(goal)
        self.planner.command(goal, self.state.stamp_ns)
        self.failure = ""

    def stop(self, text: str = "stop requested") -> None:
        """Stop the arm compliantly until `reset`."""
        self.controller.stop(requested(text))

    def reset(self) -> None:
        """Release all stops, in `RESET_ORDER`: the arm is held where it is until the next goal.

        Raises
        ------
        InputError
            If the arm still moves or is pushed, or its states are too old to tell, so that some more steps are needed;
            the message says who refuses. The stop then stays in force.
        """
        for name in RESET_ORDER:
            try:
                self._reset(name)
            except InputError as error:
                raise InputError(f"{name}: {error}") from error

    def run(
        self,
        goal: Task,
        timeout: float = 20.0,
        watch: Callable[[Tick], None] | None = None,
        until_settled: bool = False,
    ) -> Result:
        """Move the arm to a goal, until the planner gives it up. A stop ends the run, also one that was latched before.

        Parameters
        ----------
        goal
            Where the tip has to be.
        timeout
            Time to reach it, s.
        watch
            Called after each step from the goal on.
        until_settled
            Whether to wait until the tip has settled instead, which it does in `ReplanningSettings.settle_time` at
            rest.

        Raises
        ------
        InputError
            If the goal cannot be reached.
        """
        self._resolve(goal)
        if not timeout > 0.0:
            raise InputError(f"timeout = {timeout}: expected a positive time, s")
        self.warm_up()
        self.settle()
        target = self._resolve(goal)
        self.command(goal)
        begin_ns, end_ns = self._clock_ns, self._clock_ns + round(timeout * NANOSECONDS)
        duration, peak, plans = float("nan"), float("nan"), 0
        while self._clock_ns < end_ns and (self.planner.has_goal or not self.failure):
            tick = self.step()
            plans += tick.plan is not None
            forces = self.robot.contact_forces()
            if forces is not None:
                peak = max(float(forces.max()), 0.0 if np.isnan(peak) else peak)
            if watch is not None:
                watch(tick)
            if np.isnan(duration) and not self.stop_reason and goal.reached(self.tip_position, target):
                duration = (self._clock_ns - begin_ns) / NANOSECONDS
            if self.stop_reason or (self.settled if until_settled else not np.isnan(duration)):
                break
        reason = self.failure or self.stop_reason
        distance = float(np.linalg.norm(self.tip_position - target.position))
        is_reached = not np.isnan(duration) and not reason
        return Result(is_reached, duration, distance, peak, reason, plans, self.settled and not reason)

    @property
    def settled(self) -> bool:
        """Whether the tip has stayed at the last goal, at rest."""
        state = self.planner.goal_state
        return state is not None and state.phase is GoalPhase.SETTLED

    def _reset(self, name: str) -> None:
        """Reset one of `RESET_ORDER`, if it is there."""
        if name == "driver":
            self.robot.reset()
        elif name == "observer":
            self.observer.reset((self._clock_ns - self._seen_ns) / NANOSECONDS)
            self.controller.hear(self.observer.report().verdict, self._clock_ns)
        elif name == "controller":
            self.controller.reset(self._clock_ns)

    # The phases of a step; benchmarks that delay or drop messages override them.

    def _control(self) -> Array | None:
        torque = None
        for state in self._arrived:
            try:
                answer = self.controller.update(state, self._clock_ns)
            except InputError as error:
                self._refuse("joint states", error)
                continue
            if self.controller.state is not state:
                self._refuse("old joint states", InputError(f"joint state of {state.stamp_ns} ns came again or late"))
            elif answer is not None:
                torque = answer
                self._send(answer)
            try:
                self.controller.watch(state, self._clock_ns)
            except InputError as error:
                # The controller does not look into states that are not new.
                self._refuse("joint states", error)
        return torque

    def _send(self, torque: Array) -> None:
        try:
            self.robot.command(torque, self._clock_ns)
        except InputError as error:
            self._refuse("commands", error)

    def _observe(self) -> SafetyReport | None:
        report = None
        for state in self._arrived:
            try:
                report = self.observer.update(state)
            except InputError as error:
                self._refuse("observed joint states", error)
                continue
            if report is not None:
                self._seen_ns = self._clock_ns
            if report is not None and report.due:
                self.controller.hear(report.verdict, self._clock_ns)
                self._give_up(self.planner.objection(report.contact))
        if self.stop_reason:
            self._give_up(f"the arm was stopped ({self.stop_reason})")
        return report

    def _give_up(self, why: str) -> None:
        if why and self.planner.has_goal:
            self.planner.withdraw(why)
            self.controller.withdraw()

    def _look(self) -> None:
        obstacles = self.robot.obstacles()
        if obstacles is not None:
            self.planner.see(obstacles, self.state.stamp_ns)

    def _plan(self) -> Plan | None:
        self._look()
        if all(state is not self.state for state in self._arrived):
            return None
        try:
            request = self.planner.request(self.state)
            return None if request is None else self._follow(self.planner.solve(request))
        except PlanningError as error:
            self.failure = str(error)
            if not self.planner.has_goal:
                self.controller.withdraw()
        except InputError as error:
            self._refuse("plans", error)
        return None

    def _follow(self, plan: Plan) -> Plan:
        self.controller.follow(plan.references())
        self.failure = ""
        return plan

    def _refuse(self, what: str, error: InputError) -> None:
        """Count refused input if the robot injects faults; otherwise raise the error."""
        if getattr(self.robot, "faults", None) is None:
            raise error
        self.refused[what] = self.refused.get(what, 0) + 1

    def _core(self) -> PlanningCore:
        if self.planner.core is None:
            raise PlanningError("the planner has no core to make plans with: pass one to it")
        return self.planner.core

    def _resolve(self, goal: Task) -> Target:
        if not isinstance(goal, Task):
            raise InputError(f"goal is of type {type(goal).__name__}; expected Goal([0.5, 0.2, 0.3]), say")
        return self.planner.resolve(goal, self.state)


def make_planner(
    arm: Arm,
    capacity: int,
    *,
    planning: PlanningSettings | None = None,
    replanning: ReplanningSettings | None = None,
    controller: ControllerSettings | None = None,
    budget: ContactBudget | None = None,
    unexpected_contact: UnexpectedContactSettings | None = None,
    solver: Callable[[CostFunction, FloatArray, PlanningSettings], Solver] | None = None,
    deadline: float = 0.0,
) -> Planner:
    """Assemble a planner that makes plans by the package's own method.

    Parameters
    ----------
    arm
        Arm to plan for.
    capacity
        Number of obstacle spheres that plans take into account; 0 for none.
    planning, replanning, budget, unexpected_contact
        Settings; None for the defaults.
    controller
        Settings of the controller that follows the plans.
    solver
        Makes the solver from a cost, the number of its variables and the settings; None for Algorithm 1.
    deadline
        Wall-clock time that a plan may take, s, in place of that of `planning`, which is the nodes'; 0 for any, so that
        plans do not depend on how fast the machine is.
    """
    # JAX takes a while to import.
    from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
    from contact_reach_ros.planning.solver.hybrid import HybridSolver

    planning = dataclasses.replace(planning or PlanningSettings(), deadline=deadline)
    controller = (controller or ControllerSettings()).resolve(arm)
    force = (budget or ContactBudget()).permitted_force
    core = RecedingHorizonPlanner(arm, planning, controller, force, capacity, solver or HybridSolver)
    unexpected_contact = unexpected_contact or UnexpectedContactSettings()
    replanning = replanning or ReplanningSettings()
    return Planner(arm, core, replanning, unexpected_contact, task=controller.impedance.task, budget=budget)
