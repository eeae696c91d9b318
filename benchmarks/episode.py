"""One episode in this process, in lockstep and without ROS: the very objects that the nodes run.

The same arguments give the same result, bit for bit, as long as the planner has no wall-clock deadline.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from benchmarks.baselines.method import Method
from benchmarks.episode_result import EpisodeResult
from benchmarks.faulty_robot import AnyFault, Fault, FaultyRobot, Vector
from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import SafetyReport
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.planner import ReplanningSettings
from contact_reach_ros.planning.settings import UnexpectedContactSettings
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.stack import Stack
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import FREE, HOLD, TOLERANCE, Goal
from contact_reach_ros.world.scene import Scene

STILL = 0.05
"""rad: an arm none of whose joints has covered more in all of `EpisodeOptions.patience` is going nowhere."""

VIA_TOLERANCE = 0.05
"""m: a via point that is so near gives way to the target, as in the authors' code."""


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
    tolerance
        Distance that counts as reached, m.
    rate
        Of the joint states, Hz; whatever is recorded is recorded at 1 kHz.
    hold_orientation
        Whether the goal holds the orientation of the start; otherwise it is left free.
    noise_seed
        Of the sensor noise; that of the scene if there is none.
    linger
        Time to go on after the goal was reached or the arm was stopped, s.
    via
        A first goal, m, base frame, that gives way to the target within `VIA_TOLERANCE`.
    until_settled
        Whether a goal counts as reached only when it has settled, as the planner decides it: position, angle and rest.
    patience
        Time after which an arm that has stayed where it is, within `STILL`, is lost and the episode ends, s; 0 for
        never.
    faults
        What goes wrong, counted from the moment the goal is given.
    watchdog
        Of the drive.
    unexpected_contact
        What the planner does about contact with what it does not know.
    """

    period: float = 0.03
    latency: float = 0.04
    settle: float = 0.8
    timeout: float = 20.0
    rate: float = 1000.0
    tolerance: float = TOLERANCE
    hold_orientation: bool = True
    noise_seed: int | None = None
    linger: float = 0.0
    via: Vector | None = None
    until_settled: bool = False
    patience: float = 0.0
    faults: tuple[Fault, ...] = ()
    budget: ContactBudget = field(default_factory=ContactBudget)
    observer: ObserverSettings = field(default_factory=ObserverSettings)
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)
    unexpected_contact: UnexpectedContactSettings = field(default_factory=UnexpectedContactSettings)

    @property
    def replanning(self) -> ReplanningSettings:
        """`period` and `latency` as the planner takes them."""
        return ReplanningSettings(period=self.period, latency=self.latency)


@dataclass(frozen=True)
class WrongPlans(Fault):
    """Plans lead elsewhere by an offset (3,), m, base frame, last longer by a factor and arrive later by a delay, s."""

    offset: Vector = (0.0, 0.0, 0.0)
    stretch: float = 1.0
    delay: float = 0.0


@dataclass(frozen=True)
class Silent(Fault):
    """A node does nothing, as if killed or frozen. The brakes of a silent driver close, and it comes back reset."""

    node: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.node not in ("driver", "controller", "observer", "planner"):
            raise SettingsError(f"{self}: expected driver, controller, observer or planner")


class EpisodeRobot(FaultyRobot):
    """A robot that is `Silent` at times.

    It calls `after_tick` after each tick of the physics, of which there may be several between joint states.
    """

    after_tick: Callable[[], None] | None = None

    def is_silent(self, node: str) -> bool:
        """Whether a node is silent now."""
        return self.faults is not None and any(fault.node == node for fault in self.faults.active(Silent, self.now_ns))

    def read(self) -> list[JointState]:
        """As `FaultyRobot.read`; none of a silent driver."""
        if self.is_silent("driver"):
            # The noise is drawn all the same.
            self.plant.read()
            return []
        return super().read()

    def _tick(self, clock_ns: int) -> None:
        if self.is_silent("driver"):
            self.restart()
        super()._tick(clock_ns)
        if self.after_tick is not None:
            self.after_tick()


class _EpisodeStack(Stack):
    """The stack of an episode: nodes may be silent, and plans late or false."""

    def __init__(self, scene: Scene, method: Method, options: EpisodeOptions) -> None:
        period = 1.0 / options.rate
        robot = EpisodeRobot(
            scene,
            watchdog=options.watchdog,
            faults=options.faults,
            noise_seed=options.noise_seed,
            period=period,
        )
        method.planner.reset()
        super().__init__(
            scene,
            replanning=options.replanning,
            controller=method.controller(scene.arm, method.settings, period),
            observer=options.observer,
            unexpected_contact=options.unexpected_contact,
            budget=options.budget,
            planner=method.planner,
            robot=robot,
            period=period,
        )
        self.simulated = robot
        self.sent: list[tuple[int, Array]] = []
        """Everything that the controller sent, with its time, ns."""
        self._late: deque[tuple[int, Plan]] = deque()

    def _active(self, kind: type[AnyFault]) -> list[AnyFault]:
        faults = self.simulated.faults
        return [] if faults is None else faults.active(kind, self._clock_ns)

    def _control(self) -> Array | None:
        return None if self.simulated.is_silent("controller") else super()._control()

    def _observe(self) -> SafetyReport | None:
        return None if self.simulated.is_silent("observer") else super()._observe()

    def _plan(self) -> Plan | None:
        try:
            while self._late and self._late[0][0] <= self._clock_ns:
                super()._follow(self._late.popleft()[1])
        except InputError as error:
            self._refuse("plans", error)
        return None if self.simulated.is_silent("planner") else super()._plan()

    def _send(self, torque: Array) -> None:
        self.sent.append((self._clock_ns, torque))
        super()._send(torque)

    def _follow(self, plan: Plan) -> Plan:
        faults = self._active(WrongPlans)
        for wrong in faults:
            positions, duration = plan.positions + np.array(wrong.offset), wrong.stretch * plan.knot_duration_s
            plan = dataclasses.replace(plan, positions=positions, knot_duration_s=duration)
        delay = sum(wrong.delay for wrong in faults)
        if delay > 0.0:
            self._late.append((self._clock_ns + round(delay * NANOSECONDS), plan))
            return plan
        return super()._follow(plan)


def run_episode(scene: Scene, method: Method, options: EpisodeOptions) -> EpisodeResult:
    """Run one episode until the goal is reached, the arm is stopped or the time is over.

    Parameters
    ----------
    scene
        With target and obstacles.
    method
        With room for the scene's obstacles; it forgets what it did before.
    options
        Everything else.

    Raises
    ------
    SettingsError
        If the faults cannot be had together.
    """
    stack = _EpisodeStack(scene, method, options)
    plant = stack.simulated.plant
    settle_ticks, linger_ticks = round(options.settle / TICK), round(options.linger / TICK)
    joints: list[Array] = []
    positions, forces, residuals, distances, plans = [], [], [], [], []
    start_position = plant.tip_position
    orientation = HOLD if options.hold_orientation else FREE
    goals = [Goal(scene.target, orientation, tolerance=options.tolerance)]
    if options.via is not None:
        goals.insert(0, Goal(options.via, FREE, tolerance=VIA_TOLERANCE))
    first = np.array(goals[0].position)
    duration, settled, has_goal, has_ended = float("nan"), float("nan"), False, False
    end_tick = settle_ticks + round(options.timeout / TICK)

    def is_lost() -> bool:
        ticks = round(options.patience / TICK)
        return 0 < ticks <= len(joints) and not len(joints) % 500 and float(np.ptp(joints[-ticks:], 0).max()) < STILL

    def is_given_up() -> bool:
        # A plan that is refused may be followed by a better one, for as long as the goal is pursued.
        return bool(stack.failure) and not stack.planner.has_goal

    def after_tick() -> None:
        nonlocal duration, settled, has_ended, end_tick
        if has_goal and not is_given_up():
            positions.append(plant.tip_position)
            joints.append(plant.data.qpos[: scene.arm.n].copy())
            forces.append(plant.contact_forces())
            residuals.append(stack.observer.momentum.residual)
            distances.append(float(np.linalg.norm(positions[-1] - scene.target)))
            if distances[-1] <= options.tolerance and not np.isfinite(duration) and not stack.stop_reason:
                duration = len(positions) * TICK
            if stack.settled and not goals and not np.isfinite(settled) and not stack.stop_reason:
                settled = len(positions) * TICK
        done = settled if options.until_settled else duration
        if not has_ended and (np.isfinite(done) or stack.stop_reason or is_lost()):
            has_ended, end_tick = True, plant.steps + linger_ticks

    stack.simulated.after_tick = after_tick
    while plant.steps < end_tick and not is_given_up():
        if plant.steps >= settle_ticks and not has_goal:
            has_goal = True
            stack.simulated.start_faults()
            stack.command(goals.pop(0))
        elif has_goal and goals and np.linalg.norm(plant.tip_position - first) <= VIA_TOLERANCE:
            stack.command(goals.pop(0))
        step = stack.step()
        if step.plan is not None:
            plans.append(step.plan)
    n, links = scene.arm.n, len(scene.arm.contact_links)
    reasons = {
        "observer": stack.observer.monitor.stop_reason,
        "controller": stack.controller.stop_reason or stack.controller.not_vouched,
        "drive": stack.robot.stop_reason,
    }
    return EpisodeResult(
        duration=duration,
        settled=settled,
        until_settled=options.until_settled,
        start_position=start_position,
        positions=np.reshape(positions, (-1, 3)),
        joints=np.reshape(joints, (-1, n)),
        link_forces=np.reshape(forces, (-1, links)),
        external_torques=np.reshape(residuals, (-1, n)),
        distances=np.array(distances),
        stop_reason=stack.stop_reason,
        failure=stack.failure,
        plans=plans,
        reasons={name: reason for name, reason in reasons.items() if reason},
        refused=stack.refused,
        end_speed=float(np.abs(plant.data.qvel[:n]).max()),
        period=1.0 / options.rate,
        command_times=np.array([time_ns / NANOSECONDS for time_ns, _ in stack.sent]),
        commands=np.reshape([torque for _, torque in stack.sent], (-1, n)),
    )
