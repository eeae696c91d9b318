"""One episode in this process, in lockstep and without ROS: the very objects that the nodes run.

The same arguments give the same result, bit for bit, as long as the planner has no wall-clock deadline.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.baselines.method import Method, ReferenceMethod
from contact_reach_ros.errors import InputError, PlanningError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import ContactLocator
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.observer.plausibility import PlausibilityCheck, PlausibilitySettings
from contact_reach_ros.observer.safety import SafetyMonitor, SafetySettings
from contact_reach_ros.planning.problem import Goal, Plan, Spheres
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.unexpected_contact import ContactReaction, UnexpectedContactSettings
from contact_reach_ros.plant.drive import Drive, WatchdogSettings
from contact_reach_ros.plant.fault_kinds import (
    ControllerSilent,
    LatePlans,
    ObserverSilent,
    Obstacle,
    PlannerSilent,
    Schedule,
)
from contact_reach_ros.plant.faults import Faults, State
from contact_reach_ros.plant.plant import CONTACT_BODIES, TICK, Plant, Reading
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.scene import Scene
from contact_reach_ros.scenes.spheres import obstacle_spheres
from contact_reach_ros.timing import StampOrder
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_TICK_NS = int(TICK * NANOSECONDS)
_CONTACTS_NS = 10 * _TICK_NS
"""Between looks at where the arm is touched, as between the observer's heartbeats."""


@dataclass(frozen=True)
class EpisodeOptions:
    """How an episode is run.

    Attributes
    ----------
    period, latency
        Least time between plans, and from a state to the effect of its plan, s.
    settle
        Time before the goal is given, s; the brakes open within it.
    timeout
        Time to reach the goal, s.
    success
        Distance that counts as reached, m.
    hold_orientation
        Whether the goal holds the orientation of the start; otherwise it is left free.
    noise_seed
        Of the sensor noise; that of the scene if there is none.
    linger
        Time to go on after the goal was reached or the arm was stopped, s.
    faults
        What goes wrong, counted from the moment the goal is given.
    watchdog
        Of the drive; by default without a limit on speeds, which would end episodes of a method without a controller.
    unexpected_contact
        What the planner does about contact with what it does not know; None for nothing.
    """

    period: float = 0.04
    latency: float = 0.04
    settle: float = 0.8
    timeout: float = 20.0
    success: float = 0.01
    hold_orientation: bool = True
    noise_seed: int | None = None
    linger: float = 0.0
    faults: Schedule = ()
    budget: ContactBudget = field(default_factory=ContactBudget)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    joints: JointSettings = field(default_factory=JointSettings)
    watchdog: WatchdogSettings = field(default_factory=lambda: WatchdogSettings(speed_share=0.0))
    unexpected_contact: UnexpectedContactSettings | None = None


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """What happened, from the moment the goal was given.

    Attributes
    ----------
    duration
        Time until the goal was reached, s; NaN if it was not.
    start_position
        (3,) where the flange was before, m.
    positions
        (n, 3) of the flange after each tick, m.
    joints
        (n, 7) joint angles, rad.
    link_forces
        (n, 6) contact force on each of `CONTACT_BODIES`, N.
    external_torques
        (n, 7) residuals, Nm.
    torques
        (n, 7) last commanded, Nm.
    distances
        (n,) of the flange from the target, m.
    stop_reason
        Empty if nothing stopped the arm.
    failure
        Why there is no plan, if there is none; the episode ends with it.
    plans
        All plans in order.
    reasons
        Why each of `observer`, `controller` and `drive` stopped the arm, where they did.
    refused
        How many messages were refused, by what they were.
    end_speed
        Of the fastest joint at the end, rad/s.
    """

    duration: float
    start_position: Array
    positions: Array
    joints: Array
    link_forces: Array
    external_torques: Array
    torques: Array
    distances: Array
    stop_reason: str
    failure: str
    plans: list[Plan]
    reasons: dict[str, str] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    end_speed: float = float("nan")

    @property
    def contact_forces(self) -> Array:
        """(n,) largest on one body, N."""
        return self.link_forces.max(axis=1)

    @property
    def reached(self) -> bool:
        """Whether the goal was reached and nothing stopped the arm."""
        return bool(np.isfinite(self.duration)) and not self.stop_reason


def run_episode(
    scene: Scene,
    method: Method,
    options: EpisodeOptions,
    watch: Callable[[int, Plant], None] | None = None,
) -> EpisodeResult:
    """Run one episode until the goal is reached, the arm is stopped or the time is over.

    Parameters
    ----------
    scene
        With target and obstacles.
    method
        With room for the scene's obstacles; it forgets what it did before.
    options
        Everything else.
    watch
        Called after each tick with its number and the plant.

    Raises
    ------
    SettingsError
        If the faults cannot be had together, or with this method.
    """
    return _Episode(scene, method, options, watch).run()


class _Episode:
    """The state of one episode while it runs."""

    def __init__(
        self, scene: Scene, method: Method, options: EpisodeOptions, watch: Callable[[int, Plant], None] | None
    ) -> None:
        self.scene, self.method, self.options, self.watch = scene, method, options, watch
        seed = scene.seed if options.noise_seed is None else options.noise_seed
        has_obstacle = any(isinstance(fault, Obstacle) for fault in options.faults)
        self.plant = Plant(scene, options.sensors, options.joints, options.noise_seed, has_obstacle)
        # Without faults messages take no way round, which costs time.
        self.faults = Faults(options.faults, seed, self.plant) if options.faults else None
        if any(isinstance(fault, LatePlans) for fault in options.faults) and not isinstance(method, ReferenceMethod):
            raise SettingsError(f"faults: {LatePlans.KIND} needs a method that plans references")
        self.drive = Drive(self.plant, options.watchdog)
        self.observer = MomentumObserver(MomentumSettings(), RobotModel())
        self.monitor = SafetyMonitor(SafetySettings(), options.budget)
        self.check = PlausibilityCheck(PlausibilitySettings(), options.budget.contact_thresholds)
        reading = self.plant.read()
        self.known = State(0, reading)
        """The last state that can be used, as the planner knows it."""
        self.arrived = [self.known]
        method.start(reading.position, reading.velocity, 0)
        _, rotation = RobotModel().flange_pose(reading.position)
        self.goal = Goal(scene.target, rotation if options.hold_orientation else None)
        self.reaction: ContactReaction | None = None
        if options.unexpected_contact is not None:
            self.reaction = ContactReaction(options.unexpected_contact, PlanningSettings().contact_stiffness, True)
        self.locator = ContactLocator(RobotModel(), options.budget.contact_thresholds)
        self.flange_model = RobotModel()
        self.plan_due_ns = 0
        self.controlled, self.observed = StampOrder(), StampOrder()
        self.late: deque[tuple[int, Plan]] = deque()
        self.plans: list[Plan] = []
        self.failure = ""
        self.refused: dict[str, int] = {}
        self.torque = np.full(iiwa14.N_JOINTS, np.nan)

    @property
    def is_stopped(self) -> bool:
        return bool(self.method.stop_reason or self.drive.stop_reason)

    def run(self) -> EpisodeResult:
        """All ticks."""
        options, plant, scene = self.options, self.plant, self.scene
        settle_ticks, linger_ticks = round(options.settle / TICK), round(options.linger / TICK)
        positions, joints, forces, residuals, torques, distances = [], [], [], [], [], []
        duration = float("nan")
        start_position = plant.flange_position
        end_tick = settle_ticks + round(options.timeout / TICK)
        tick, has_ended = 0, False
        while tick < end_tick:
            now_ns = tick * _TICK_NS
            if tick == settle_ticks and self.faults is not None:
                self.faults.start(now_ns)
            if tick >= settle_ticks:
                self._plan(now_ns)
                if self.failure:
                    break
            self._control(now_ns)
            self._move(now_ns)
            self._observe(now_ns)
            if self.watch is not None:
                self.watch(tick, plant)
            tick += 1
            if tick > settle_ticks:
                positions.append(plant.flange_position)
                joints.append(plant.data.qpos[: iiwa14.N_JOINTS].copy())
                forces.append(plant.contact_forces())
                residuals.append(self.observer.residual)
                torques.append(self.torque)
                distances.append(float(np.linalg.norm(positions[-1] - scene.target)))
                if distances[-1] <= options.success and not np.isfinite(duration) and not self.is_stopped:
                    duration = (tick - settle_ticks) * TICK
            if not has_ended and (np.isfinite(duration) or self.is_stopped):
                has_ended, end_tick = True, tick + linger_ticks
        return EpisodeResult(
            duration=duration,
            start_position=start_position,
            positions=np.reshape(positions, (-1, 3)),
            joints=np.reshape(joints, (-1, iiwa14.N_JOINTS)),
            link_forces=np.reshape(forces, (-1, len(CONTACT_BODIES))),
            external_torques=np.reshape(residuals, (-1, iiwa14.N_JOINTS)),
            torques=np.reshape(torques, (-1, iiwa14.N_JOINTS)),
            distances=np.array(distances),
            stop_reason=self.method.stop_reason or self.drive.stop_reason,
            failure=self.failure,
            plans=self.plans,
            reasons=self._reasons(),
            refused=self.refused,
            end_speed=float(np.abs(plant.data.qvel[: iiwa14.N_JOINTS]).max()),
        )

    def _reasons(self) -> dict[str, str]:
        reasons = {
            "observer": self.monitor.stop_reason,
            "controller": self.method.stop_reason,
            "drive": self.drive.stop_reason,
        }
        return {name: reason for name, reason in reasons.items() if reason}

    def _plan(self, now_ns: int) -> None:
        """Plan if it is time, from the last state that arrived and by its stamp."""
        method, faults = self.method, self.faults
        stamp_ns, reading = self.known
        try:
            while self.late and self.late[0][0] <= now_ns and isinstance(method, ReferenceMethod):
                method.follow(self.late.popleft()[1], stamp_ns)
        except InputError:
            self._refuse("plans")
        if stamp_ns < self.plan_due_ns or (faults is not None and faults.silent(PlannerSilent, now_ns)):
            return
        self.plan_due_ns = stamp_ns + round(self.options.period / TICK) * _TICK_NS
        effect_ns = stamp_ns + round(self.options.latency * NANOSECONDS)
        goal, spheres = self.goal, self._known_spheres()
        if self.reaction is not None:
            flange, _ = self.flange_model.flange_pose(reading.position)
            self.reaction.moved(flange)
            goal, spheres = self.reaction.goal(goal), self.reaction.spheres(spheres)
        asked = (reading.position, reading.velocity, stamp_ns, effect_ns, goal, spheres)
        delay = 0.0 if faults is None else faults.plan_delay(now_ns)
        try:
            if delay > 0.0 and isinstance(method, ReferenceMethod):
                plan = method.planner.plan(*asked)
                self.late.append((now_ns + round(delay * NANOSECONDS), plan))
            else:
                plan = method.plan(*asked)
        except PlanningError as error:
            self.failure = str(error)
            return
        except InputError:
            self._refuse("plans")
            return
        self.plans.append(plan)

    def _control(self, now_ns: int) -> None:
        """The controller's tick for each state that arrived, as the node does it."""
        faults = self.faults
        if faults is not None and faults.silent(ControllerSilent, now_ns):
            return
        for stamp_ns, reading in self.arrived:
            if faults is not None and not self.controlled.is_new(stamp_ns):
                self._refuse("old joint states")
                continue
            try:
                torque = self.method.torque(reading.position, reading.velocity, stamp_ns, now_ns)
            except InputError:
                self._refuse("joint states")
                continue
            if torque is None:
                continue
            self.torque = torque
            if faults is None:
                self.drive.command(self.torque, now_ns)
            else:
                faults.send_command(self.torque, now_ns)

    def _move(self, now_ns: int) -> None:
        """One tick of drive and plant; what is read then arrives at the next tick."""
        next_ns = now_ns + _TICK_NS
        if self.faults is None:
            self.drive.tick(now_ns)
            self.known = State(next_ns, self.plant.read())
            self.arrived = [self.known]
            return
        for torque in self.faults.commands(now_ns):
            try:
                self.drive.command(torque, now_ns)
            except InputError:
                self._refuse("commands")
        self.faults.act(now_ns)
        self.drive.tick(now_ns)
        self.faults.send_state(self.plant.read(), next_ns)
        self.arrived = self.faults.states(next_ns)
        for state in self.arrived:
            if state.is_finite:
                self.known = state

    def _observe(self, now_ns: int) -> None:
        """The observer's turn for each state that arrived, as the node does it."""
        if self.faults is not None and self.faults.silent(ObserverSilent, now_ns):
            return
        for state in self.arrived:
            reading = state.reading
            if self.faults is not None and not (state.is_finite and self.observed.is_new(state.stamp_ns)):
                continue
            self.observer.update(reading.position, reading.velocity, _known(reading), state.stamp_ns)
            self.monitor.update(self.observer.residual, reading.velocity, self.observer.known_for)
            wrong = self.check.update(reading.position, reading.velocity, self.monitor.sudden, state.stamp_ns)
            if wrong:
                self.monitor.stop_distrusting(wrong)
            self.method.observer_report(self.monitor.stop_reason, now_ns, self.monitor.distrust)
            if self.reaction is not None and state.stamp_ns % _CONTACTS_NS == 0:
                touching = self.monitor.in_contact
                contact = self.locator.locate(reading.position, self.monitor.sudden) if touching else None
                if self.reaction.report(contact, reading.position, self._known_spheres(), state.stamp_ns):
                    self.plan_due_ns = state.stamp_ns

    def _known_spheres(self) -> Spheres:
        return obstacle_spheres(self.scene, self.plant.obstacle_positions())

    def _refuse(self, what: str) -> None:
        """Count the input that is being refused; without faults nothing is."""
        if self.faults is None:
            raise
        self.refused[what] = self.refused.get(what, 0) + 1


def _known(reading: Reading) -> Array | None:
    return reading.torque if np.isfinite(reading.torque.sum()) else None
