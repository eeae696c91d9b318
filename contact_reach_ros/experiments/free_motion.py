"""An arm in free motion: the real controller follows random references in the simulation, and the observer watches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.observer.safety import SafetyMonitor, SafetySettings
from contact_reach_ros.plant.drive import Drive, WatchdogSettings
from contact_reach_ros.plant.plant import TICK, Plant
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.scene import MismatchSettings, Scene
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

REACH = np.array([1.2, 0.5, 0.8, 0.6, 1.2, 0.6, 1.5])
"""How far postures lie from home, (7,), rad: where arms work, with elbow and wrist bent."""
SPEED_SHARES = (0.1, 0.5)
"""Least and greatest peak speed of a motion, as shares of the speed limits."""
START = 0.8
"""Until the arm has been handed over and is watched in full, s."""

_TICK_NS = int(TICK * NANOSECONDS)
_HOME = np.array(iiwa14.HOME_POSITION)
_PLAN_TICKS = 40
_KNOTS = 4
_REST = 0.3


class FreeMotion:
    """One arm that moves from one random posture to the next, in lockstep.

    The references come as the planner's do: each 40 ms four knots of as long.

    Attributes
    ----------
    plant
        The simulation; who pushes the arm does it here.
    observer, monitor
        What watches; a stop does not reach the controller.
    position, velocity
        Of the last state, (7,), rad and rad/s.
    """

    def __init__(self, mismatch: MismatchSettings, seed: int, budget: ContactBudget) -> None:
        self._random = np.random.default_rng(seed)
        self.plant = Plant(
            Scene("free motion", seed, _HOME, np.zeros(3), mismatch=mismatch), SensorSettings(), JointSettings()
        )
        self._drive = Drive(self.plant, WatchdogSettings())
        self.observer = MomentumObserver(MomentumSettings(), RobotModel())
        self.monitor = SafetyMonitor(SafetySettings(), budget)
        self._controller = Controller(ControllerSettings(), RobotModel())
        self._kinematics = RobotModel()
        reading = self.plant.read()
        self.position, self.velocity = reading.position, reading.velocity
        self._controller.start(self.position, self.velocity, 0)
        self._from = self._to = _HOME
        self._begin, self._duration = START, 0.0

    @property
    def controller_stopped(self) -> str:
        """Why the controller stopped the arm, as for its speed after a push; empty while the motion goes on."""
        return self._controller.stop_reason

    def tick(self) -> None:
        """Advance by one state."""
        steps = self.plant.steps
        now_ns = steps * _TICK_NS
        if steps % _PLAN_TICKS == 0:
            self._plan(steps * TICK, now_ns)
        torque = self._controller.tick(self.position, self.velocity, now_ns, now_ns)
        if torque is not None:
            self._drive.command(torque, now_ns)
        self._drive.tick(now_ns)
        reading = self.plant.read()
        self.position, self.velocity = reading.position, reading.velocity
        acting = reading.torque if np.isfinite(reading.torque.sum()) else None
        residual = self.observer.update(self.position, self.velocity, acting, now_ns + _TICK_NS)
        self.monitor.update(residual, self.velocity, self.observer.known_for)

    def _plan(self, now: float, now_ns: int) -> None:
        if now > self._begin + self._duration:
            self._choose(now)
        times = now + _PLAN_TICKS * TICK * np.arange(_KNOTS)
        postures = np.array([self._posture(time) for time in times])
        positions, rotations = zip(*(self._kinematics.flange_pose(posture) for posture in postures), strict=True)
        ends_ns = tuple(_PLAN_TICKS * _TICK_NS * (knot + 1) for knot in range(_KNOTS))
        references = self._controller.references
        references.offer_poses(PoseKnots(now_ns, ends_ns, np.array(positions), np.array(rotations)), now_ns)
        references.offer_postures(PostureKnots(now_ns, ends_ns, postures), now_ns)

    def _choose(self, now: float) -> None:
        """The next posture, and how long it takes; sometimes after a rest."""
        random, limits = self._random, np.array(iiwa14.VELOCITY_LIMITS)
        self._from, self._to = self._to, _HOME + random.uniform(-REACH, REACH)
        # The peak speed of a minimum-jerk motion is 15/8 of its mean.
        share = random.uniform(*SPEED_SHARES)
        self._duration = float((1.875 * np.abs(self._to - self._from) / (share * limits)).max())
        self._begin = now + random.choice([0.0, _REST])

    def _posture(self, time: float) -> Array:
        share = min(max((time - self._begin) / self._duration, 0.0), 1.0) if self._duration > 0.0 else 0.0
        return self._from + share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * (self._to - self._from)
