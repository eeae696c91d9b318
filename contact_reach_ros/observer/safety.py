"""The safety state machine: a latched stop above the contact budget."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings, setting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SafetySettings(Settings):
    """Settings of the safety state machine."""

    debounce: int = setting(3, "states in a row above a threshold that stop the arm", minimum=1, maximum=100)
    reset_share: float = setting(
        0.5, "share of the thresholds below which a stop may be reset", minimum=0.01, maximum=1.0
    )
    reset_velocity: float = setting(
        0.05, "joint speed below which a stop may be reset", unit="rad/s", minimum=0.0, maximum=1.0
    )


class SafetyMonitor:
    """Watches the external torque; above the budget the stop is latched until `reset`.

    Attributes
    ----------
    stop_reason
        Why the arm is stopped; empty while it is not.
    stops
        How often it has been stopped.
    """

    def __init__(self, settings: SafetySettings, budget: ContactBudget) -> None:
        self.settings = settings
        self.stop_reason = ""
        self.stops = 0
        self._thresholds = np.array(budget.torque_thresholds)
        self._threshold_list = self._thresholds.tolist()
        self._above = 0
        self._last_residual = np.zeros(iiwa14.N_JOINTS)
        self._last_velocity = np.zeros(iiwa14.N_JOINTS)

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return bool(self.stop_reason)

    def update(self, residual: Array, v: Array) -> None:
        """Take the external torque (7,) in N m and the joint velocities (7,) in rad/s of one state."""
        self._last_residual = residual
        self._last_velocity = v
        # For seven numbers a loop is faster than NumPy. A residual that is not a number is above, too.
        for value, threshold in zip(residual.tolist(), self._threshold_list, strict=True):
            if not -threshold <= value <= threshold:
                break
        else:
            self._above = 0
            return
        self._above += 1
        if self._above >= self.settings.debounce:
            joint = int(np.argmax(np.abs(residual) / self._thresholds))
            name, torque, threshold = iiwa14.JOINT_NAMES[joint], residual[joint], self._thresholds[joint]
            self.stop(f"external torque on {name} is {torque:.1f} Nm, permitted {threshold:g} Nm")

    def stop(self, reason: str) -> None:
        """Latch a stop; the first reason is kept."""
        if not self.stopped:
            self.stop_reason = reason
            self.stops += 1

    def reset(self) -> None:
        """Release the stop.

        Raises
        ------
        InputError
            If the arm moves or is still pushed; the stop stays.
        """
        speed = float(np.abs(self._last_velocity).max())
        if not speed <= self.settings.reset_velocity:
            raise InputError(
                f"the arm moves with {speed:.3f} rad/s; reset needs at most "
                f"{self.settings.reset_velocity:g} rad/s: wait for it"
            )
        limits = self.settings.reset_share * self._thresholds
        # Not `>`: a residual that is not a number is no reason to let go.
        pushed = ~(np.abs(self._last_residual) <= limits)
        if pushed.any():
            joint = int(np.argmax(np.abs(self._last_residual) / limits))
            raise InputError(
                f"external torque on {iiwa14.JOINT_NAMES[joint]} is {self._last_residual[joint]:.1f} Nm; "
                f"reset needs at most {limits[joint]:g} Nm: free the arm"
            )
        self.stop_reason = ""
        self._above = 0
