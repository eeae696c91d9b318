"""The robot's own watchdog: it holds and brakes the arm when commands cease or make it too fast."""

from __future__ import annotations

import math

from contact_reach_ros.arm import Array, checked_torque
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import InputError, StopCode, StopReason
from contact_reach_ros.simulation.plant import Actuation, Plant
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.timing import NANOSECONDS

HOLD_AFTER = 0.02
"""Time without a command after which the damped hold begins, s."""
STOP_AFTER = 0.1
"""Time without a command after which the brakes close and stay closed, s."""
OPEN_AFTER = 0.5
"""Time of steady commands after which the brakes open, s: a controller that is starting up pauses now and then."""


class Drive:
    """Passes commands to the plant and watches them.

    The brakes are closed until commands have arrived for `OPEN_AFTER` seconds without a gap of `HOLD_AFTER`, so that a
    controller that is still starting up does not get the arm. From then on, `HOLD_AFTER` seconds without a command
    trigger the damped hold, and `STOP_AFTER` seconds a stop that is latched until `reset`. A joint that is too fast by
    the drive's own sensors triggers a stop too, even if the joint states that it sends are faulty.

    With `enabled: false` it does not watch for silence, and holds the last torque for ever. With `carries: true` it
    carries the arm itself, by its own model: commands are on top of that.

    Attributes
    ----------
    stop_reason
        Why the arm is stopped; empty while it is not.
    rejected
        Number of refused commands.
    is_open
        Whether the arm has been handed over: the brakes are open, or were before a stop.
    """

    def __init__(self, plant: Plant, settings: WatchdogSettings, open_after: float = OPEN_AFTER) -> None:
        """`open_after`: time of steady commands after which the brakes open, s."""
        self.plant = plant
        self.stop_reason = ""
        self.rejected = 0
        self._open_ns = int(open_after * NANOSECONDS)
        self._hold_ns = int(HOLD_AFTER * NANOSECONDS)
        self._stop_ns = int(STOP_AFTER * NANOSECONDS)
        self._watches_silence = settings.enabled
        self._model = RobotModel(plant.arm) if settings.carries else None
        share = settings.speed_share or math.inf
        self._speed_limits = [share * limit for limit in plant.arm.velocity_limits.tolist()]
        self._command: Array | None = None
        self._command_ns = 0
        self._steady_since_ns = 0
        self.is_open = False

    def command(self, torque: Array, clock_ns: int) -> None:
        """Take a command (n,) in N m that arrived at `clock_ns`.

        Raises `InputError` if it has the wrong size or is not finite; it is counted, and the last one stays in force.
        """
        try:
            checked_torque(torque, self.plant.arm.n)
        except InputError:
            self.rejected += 1
            raise
        if self._command is None or clock_ns - self._command_ns > self._hold_ns:
            self._steady_since_ns = clock_ns
        self._command = torque
        self._command_ns = clock_ns

    def tick(self, clock_ns: int) -> None:
        """Advance the plant by one tick under the present command."""
        silence = clock_ns - self._command_ns
        if self._command is not None and silence <= self._hold_ns:
            self.is_open = self.is_open or clock_ns - self._steady_since_ns >= self._open_ns
        if self.is_open and not self.stop_reason:
            self._watch_speed()
        if self.stop_reason or not self.is_open:
            actuation = Actuation.BRAKED
        elif not self._watches_silence:
            actuation = Actuation.COMMANDED
        elif silence > self._stop_ns:
            self.stop(StopReason(StopCode.NO_COMMAND, f"no command for {silence / NANOSECONDS * 1000:.0f} ms"))
            actuation = Actuation.BRAKED
        elif silence > self._hold_ns:
            actuation = Actuation.DAMPED_HOLD
        else:
            actuation = Actuation.COMMANDED
        self.plant.set_actuation(actuation)
        torque = self._command
        if torque is not None and self._model is not None:
            torque = torque + self._model.gravity_at(self.plant.joint_positions)
        self.plant.step(torque)

    def _watch_speed(self) -> None:
        arm = self.plant.arm
        for name, speed, limit in zip(arm.joint_names, self.plant.data.qvel.tolist(), self._speed_limits, strict=False):
            if not -limit <= speed <= limit:
                text = f"{name} moves with {abs(speed):.2f} rad/s, permitted {limit:.2f} rad/s"
                self.stop(StopReason(StopCode.SPEED_LIMIT, text))

    def stop(self, reason: str) -> None:
        """Close the brakes until `reset`; the first reason is kept."""
        if not self.stop_reason:
            self.stop_reason = reason

    def reset(self) -> None:
        """Release a stop; the brakes open again after steady commands."""
        self.stop_reason = ""
        self._command = None
        self.is_open = False
