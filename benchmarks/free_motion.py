"""An arm in free motion: the real controller follows random references in the simulation, and the observer watches."""

from __future__ import annotations

import math

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.references import References
from contact_reach_ros.control.settings import ControllerSettings, SupervisionSettings
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.safety import HANDOVER_TIME, SafetyMonitor
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.scene import MismatchSettings, Scene

REACH = (1.2, 0.5, 0.8, 0.6, 1.2, 0.6, 1.5)
"""How far postures lie from home, joint by joint, rad: where arms work, elbow and wrist bent; repeated for more joints.
"""
SPEED_SHARES = (0.05, 0.2)
"""Least and greatest peak speed of a motion, as shares of the speed limits: what the caps permit."""
START = 0.8
"""Until the arm has been handed over and is watched in full, s."""

LONGEST_CONTROLLED = 0.005
"""Period of states up to which the package's controller moves the arm, s; slower ones are for watching."""

_SUPERVISION = SupervisionSettings(max_position_error=10.0, max_rotation_error=3.2, max_posture_error=7.0)
"""The references lead the arm by more than a planner's do."""

_TICK_NS = int(TICK * NANOSECONDS)
_PLAN_TICKS = 40
_KNOTS = 4
_REST = 0.3


class FreeMotion:
    """One arm that moves from one random posture to the next, in lockstep.

    The references come as the planner's do: each 40 ms four knots of as long, but further ahead.

    Attributes
    ----------
    plant
        The simulation, which can be pushed.
    observer
        Watches the arm; a stop does not reach the controller.
    state
        The last joint state.
    """

    def __init__(
        self,
        arm: Arm,
        mismatch: MismatchSettings,
        seed: int,
        budget: ContactBudget,
        period: float = TICK,
        settings: ObserverSettings | None = None,
        moves: bool = True,
    ) -> None:
        """`period` of the states that the observer sees, s; beyond `LONGEST_CONTROLLED` another controller moves it.

        `settings` of the observer, None for the defaults. Unless it `moves`, the arm is held in its home posture.
        """
        control_period = period if period <= LONGEST_CONTROLLED else TICK
        self._every = round(period / control_period)
        self._arm = arm
        self._random = np.random.default_rng(seed)
        self._home, self._reach = np.array(arm.home), np.resize(REACH, arm.n)
        scene = Scene("free motion", arm, seed, self._home, np.zeros(3), mismatch=mismatch)
        self._robot = SimulatedRobot(scene, period=control_period)
        self.plant = self._robot.plant
        self.observer = Observer(arm, settings or ObserverSettings(), budget, period)
        self._controller = Controller(arm, ControllerSettings(supervision=_SUPERVISION), control_period)
        (self.state,) = self._robot.read()
        self._from = self._to = self._home
        self._begin, self._duration = START if moves else math.inf, 0.0

    @property
    def controller_stopped(self) -> str:
        """Why the controller stopped the arm, as for its speed after a push; empty while the motion goes on."""
        return self._controller.stop_reason

    @property
    def is_handed_over(self) -> bool:
        """Whether the hand-over is complete, and the arm watched in full."""
        return self.observer.momentum.known_for >= HANDOVER_TIME

    @property
    def monitor(self) -> SafetyMonitor:
        """The observer's state machine."""
        return self.observer.monitor

    def tick(self) -> None:
        """Advance by one state of the observer."""
        for _ in range(self._every):
            self._control()
        report = self.observer.update(self.state)
        if report is not None and report.due:
            self._controller.hear(
                report.verdict._replace(reason="", distrust="", contact="", excess=False), self.state.stamp_ns
            )

    def _control(self) -> None:
        robot, state = self._robot, self.state
        now_ns = state.stamp_ns
        if self.plant.steps % _PLAN_TICKS == 0:
            self._plan(self.plant.time, now_ns)
        torque = self._controller.update(state, now_ns)
        if torque is not None:
            robot.command(torque, now_ns)
        robot.step(now_ns)
        (self.state,) = robot.read()

    def _plan(self, now: float, now_ns: int) -> None:
        if now > self._begin + self._duration:
            self._choose(now)
        times = now + _PLAN_TICKS * TICK * np.arange(_KNOTS)
        postures = np.array([self._posture(time) for time in times])
        positions, rotations = zip(*(self._controller.model.tip_pose(posture) for posture in postures), strict=True)
        ends_ns = tuple(_PLAN_TICKS * _TICK_NS * (knot + 1) for knot in range(_KNOTS))
        self._controller.follower.queue.offer(
            References(now_ns, ends_ns, np.array(positions), np.array(rotations), postures), now_ns
        )

    def _choose(self, now: float) -> None:
        """The next posture, and how long it takes; sometimes after a rest."""
        random, limits = self._random, self._arm.velocity_limits
        self._from, self._to = self._to, self._home + random.uniform(-self._reach, self._reach)
        # The peak speed of a minimum-jerk motion is 15/8 of its mean.
        share = random.uniform(*SPEED_SHARES)
        self._duration = float((1.875 * np.abs(self._to - self._from) / (share * limits)).max())
        self._begin = now + random.choice([0.0, _REST])

    def _posture(self, time: float) -> Array:
        share = min(max((time - self._begin) / self._duration, 0.0), 1.0) if self._duration > 0.0 else 0.0
        return self._from + share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * (self._to - self._from)
