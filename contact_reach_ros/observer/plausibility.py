"""Whether joint states can be true: positions that fit velocities, and encoders that still see their joint move."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_MEMORY = 0.2
"""Time constant with which a difference between position and integrated velocity is forgotten, s."""
_MAX_STEP_NS = 3_000_000
"""Over longer steps between states velocities say too little about positions."""


@dataclass(frozen=True)
class PlausibilitySettings(Settings):
    """When joint states are no longer believed."""

    position_slip: float = setting(
        0.02,
        "difference between a position and its integrated velocity that stops the arm, forgotten over 0.2 s",
        unit="rad",
        minimum=0.001,
        maximum=0.5,
    )
    frozen_states: int = setting(
        30,
        "a position that stays the same, to the last bit, for so many states while the joint's sudden external torque "
        "is that of a contact stops the arm: the encoder is stuck, or the joint blocked",
        minimum=5,
        maximum=10000,
    )


class PlausibilityCheck:
    """Watches for joint states on which nobody may act, not even to stop the arm softly.

    Two things cannot be. A position that goes elsewhere than its velocity says: ∫(dq − q̇ dt), with a slow leak, has to
    stay near zero. And a position that does not change at all while torque acts on the joint: a contact that the
    momentum observer would call the torque's cause bends the compliant arm by more than an encoder's resolution.
    """

    def __init__(self, settings: PlausibilitySettings, contact_thresholds: tuple[float, ...]) -> None:
        """`contact_thresholds`: sudden external torque (7,) that would move a joint, N m."""
        self._settings = settings
        self._thresholds = contact_thresholds
        self._q: list[float] | None = None
        self._v = [0.0] * iiwa14.N_JOINTS
        self._stamp_ns = 0
        self._slips = [0.0] * iiwa14.N_JOINTS
        self._same = [0] * iiwa14.N_JOINTS

    def update(self, q: Array, v: Array, sudden: Array | None, stamp_ns: int) -> str:
        """Take one state; what is wrong with it and the ones before, empty while nothing is.

        Parameters
        ----------
        q, v
            Joint positions (7,) rad and velocities (7,) rad/s.
        sudden
            Sudden external torque (7,), N m; None while it is unknown.
        stamp_ns
            Time of the state.
        """
        positions, speeds = q.tolist(), v.tolist()
        previous, last_speeds, elapsed_ns = self._q, self._v, stamp_ns - self._stamp_ns
        self._q, self._v, self._stamp_ns = positions, speeds, stamp_ns
        if previous is None or not 0 < elapsed_ns <= _MAX_STEP_NS:
            self._slips = [0.0] * iiwa14.N_JOINTS
            return ""
        elapsed = elapsed_ns / NANOSECONDS
        keep, half = math.exp(-elapsed / _MEMORY), 0.5 * elapsed
        # For seven numbers loops over plain floats are faster than NumPy.
        for joint, (now, before, speed, last) in enumerate(zip(positions, previous, speeds, last_speeds, strict=True)):
            self._slips[joint] = keep * self._slips[joint] + now - before - half * (speed + last)
            self._same[joint] = self._same[joint] + 1 if now == before else 0
        for joint, slip in enumerate(self._slips):
            if not -self._settings.position_slip <= slip <= self._settings.position_slip:
                return (
                    f"position and velocity of {iiwa14.JOINT_NAMES[joint]} differ by {slip:.3f} rad, permitted "
                    f"{self._settings.position_slip:g} rad: look at its encoder"
                )
        if sudden is None or max(self._same) < self._settings.frozen_states:
            return ""
        for joint, (states, torque) in enumerate(zip(self._same, sudden.tolist(), strict=True)):
            if states >= self._settings.frozen_states and abs(torque) > self._thresholds[joint]:
                return (
                    f"the position of {iiwa14.JOINT_NAMES[joint]} has not changed for {states} states under a sudden "
                    f"external torque of {torque:.1f} Nm: its encoder is stuck, or the joint blocked"
                )
        return ""
