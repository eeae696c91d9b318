"""The robot's own watchdog: what the arm does when commands stop coming, or let it get too fast."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.plant.plant import Actuation, Plant
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WatchdogSettings(Settings):
    """When the brakes open, and when the drive closes them by itself."""

    open_after: float = setting(
        0.5, "time of steady commands after which the brakes open", unit="s", minimum=0.0, maximum=5.0
    )
    hold_after: float = setting(
        0.02, "silence after which the arm is held with damping", unit="s", minimum=0.002, maximum=1.0
    )
    stop_after: float = setting(
        0.1, "silence after which the brakes close and stay closed", unit="s", minimum=0.005, maximum=5.0
    )
    speed_share: float = setting(
        1.1,
        "joint speed at which the brakes close and stay closed, as a share of the data sheet's limit, 0 for none; "
        "above that of the controller, which stops the arm more softly",
        minimum=0.0,
        maximum=2.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold_after >= self.stop_after:
            raise SettingsError(
                f"WatchdogSettings.hold_after = {self.hold_after:g}: expected less than stop_after, "
                f"{self.stop_after:g} s; the arm is held before it is stopped"
            )


class Drive:
    """Feeds commands to the plant and watches over them.

    The brakes are closed until commands have come for `open_after` seconds without a gap of `hold_after`, so that a
    controller which is still starting up is not handed the arm. From then on commands that stop for `hold_after`
    seconds bring the damped hold, for `stop_after` seconds a stop that is latched until `reset`. So does a joint that
    is too fast by the drive's own sensors, whatever becomes of the joint states that it sends.

    Attributes
    ----------
    stop_reason
        Why the arm is stopped; empty while it is not.
    rejected
        Commands that were refused.
    """

    def __init__(self, plant: Plant, settings: WatchdogSettings) -> None:
        self.plant = plant
        self.stop_reason = ""
        self.rejected = 0
        self._open_ns = int(settings.open_after * NANOSECONDS)
        self._hold_ns = int(settings.hold_after * NANOSECONDS)
        self._stop_ns = int(settings.stop_after * NANOSECONDS)
        share = settings.speed_share or math.inf
        self._speed_limits = [share * limit for limit in iiwa14.VELOCITY_LIMITS]
        self._command: Array | None = None
        self._command_ns = 0
        self._steady_since_ns = 0
        self._opened = False

    @property
    def is_open(self) -> bool:
        """Whether the arm has been handed over: the brakes are open, or were before a stop."""
        return self._opened

    def command(self, torque: Array, clock_ns: int) -> None:
        """Take a command (7,) in N m that arrived at `clock_ns`.

        Raises
        ------
        InputError
            If it has the wrong size or is not finite; it is counted and the last one stays.
        """
        try:
            checked_command(torque)
        except InputError:
            self.rejected += 1
            raise
        if self._command is None or clock_ns - self._command_ns > self._hold_ns:
            self._steady_since_ns = clock_ns
        self._command = torque
        self._command_ns = clock_ns

    def tick(self, clock_ns: int) -> None:
        """Advance the plant by one tick under the command at hand."""
        silence = clock_ns - self._command_ns
        if self._command is not None and silence <= self._hold_ns:
            self._opened = self._opened or clock_ns - self._steady_since_ns >= self._open_ns
        if self._opened and not self.stop_reason:
            self._watch_speed()
        if self.stop_reason or not self._opened:
            actuation = Actuation.BRAKED
        elif silence > self._stop_ns:
            self.stop(f"no command for {silence / NANOSECONDS * 1000:.0f} ms")
            actuation = Actuation.BRAKED
        elif silence > self._hold_ns:
            actuation = Actuation.DAMPED_HOLD
        else:
            actuation = Actuation.COMMANDED
        self.plant.set_actuation(actuation)
        self.plant.step(self._command)

    def _watch_speed(self) -> None:
        for joint, (speed, limit) in enumerate(zip(self.plant.joint_velocities, self._speed_limits, strict=True)):
            if not -limit <= speed <= limit:
                self.stop(f"{iiwa14.JOINT_NAMES[joint]} moves with {abs(speed):.2f} rad/s, permitted {limit:.2f} rad/s")

    def stop(self, reason: str) -> None:
        """Close the brakes until `reset`; the first reason is kept."""
        if not self.stop_reason:
            self.stop_reason = reason

    def reset(self) -> None:
        """Release a stop; the brakes open again after steady commands."""
        self.stop_reason = ""
        self._command = None
        self._opened = False


def checked_command(torque: Array) -> Array:
    """The same torques (7,), N m.

    Raises
    ------
    InputError
        If there are not seven of them or one is not finite.
    """
    if torque.shape != (iiwa14.N_JOINTS,):
        raise InputError(f"effort_controller/commands: data has {torque.size} values; expected {iiwa14.N_JOINTS}")
    if not math.isfinite(sum(torque.tolist())):
        raise InputError(f"effort_controller/commands: data = {torque.tolist()}; expected finite torques")
    return torque
