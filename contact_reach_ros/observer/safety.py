"""The safety state machine: contact is told, and above the contact budget the stop is latched."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings, setting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SafetySettings(Settings):
    """Settings of the safety state machine; what counts as too much is in the contact budget."""

    debounce: int = setting(3, "states in a row above a threshold that stop the arm", minimum=1, maximum=100)
    contact_debounce: int = setting(2, "states in a row above a threshold that are a contact", minimum=1, maximum=100)
    handover_debounce: int = setting(
        30, "states in a row above a threshold that stop the arm at hand-over", minimum=1, maximum=1000
    )
    contact_release: float = setting(
        0.6, "share of the thresholds below which a contact ends", minimum=0.01, maximum=1.0
    )
    release_debounce: int = setting(50, "states in a row below it that end a contact", minimum=1, maximum=1000)
    mean_states: int = setting(
        300,
        "states over which the slow mean follows the external torque; ten times as many in contact",
        minimum=2,
        maximum=100000,
    )
    reset_share: float = setting(
        0.5, "share of the thresholds below which a stop may be reset", minimum=0.01, maximum=1.0
    )
    reset_velocity: float = setting(
        0.05, "joint speed below which a stop may be reset", unit="rad/s", minimum=0.0, maximum=1.0
    )


DISTRUST = "distrust"
"""Name of a value in safety_state: what is wrong with the joint states or the model, on which a stop relies, too."""


class Level(Enum):
    """What the external torque says."""

    FREE = "free"
    CONTACT = "contact"
    """Something touches the arm, within the budget."""
    COLLISION = "collision"
    """Above the budget, or stopped for another reason: the stop is latched."""


_CONTACT_MEMORY = 10
_HANDOVER_STATES = 10
"""Over which the slow mean follows while the arm is handed over."""


class SafetyMonitor:
    """Watches the external torque; above the budget the stop is latched until `reset`.

    The error of the model changes as slowly as the arm's posture, a contact does not: beside the external torque itself
    its deviation from its own slow mean is watched, with much lower thresholds.

    Attributes
    ----------
    stop_reason
        Why the arm is stopped; empty while it is not.
    distrust
        What is wrong with what a compliant stop relies on, the joint states or the model; empty until something is, and
        after a reset.
    stops
        How often it has been stopped.
    in_contact
        Whether something touches the arm, with hysteresis.
    contacts
        How often that began.
    """

    def __init__(self, settings: SafetySettings, budget: ContactBudget) -> None:
        self.settings = settings
        self.budget = budget
        self.stop_reason = ""
        self.distrust = ""
        self.stops = 0
        self.in_contact = False
        self.contacts = 0
        # For seven numbers loops over plain floats are faster than NumPy.
        self._mean = [0.0] * iiwa14.N_JOINTS
        self._stop_limits = list(
            zip(budget.torque_thresholds, budget.torque_per_speed, budget.sudden_thresholds, strict=True)
        )
        self._contact_limits = self._scaled_contact_limits(1.0)
        self._release_limits = self._scaled_contact_limits(settings.contact_release)
        self._handover_limits = np.array(budget.handover_thresholds)
        self._above = 0
        self._touched = 0
        self._untouched = 0
        self._handed_over_above = 0
        self._last_residual = np.zeros(iiwa14.N_JOINTS)
        self._last_velocity = np.zeros(iiwa14.N_JOINTS)

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return bool(self.stop_reason)

    @property
    def level(self) -> Level:
        """What the external torque says."""
        if self.stop_reason:
            return Level.COLLISION
        return Level.CONTACT if self.in_contact else Level.FREE

    @property
    def sudden(self) -> Array:
        """External torque less its slow mean at the last state, (7,), N m."""
        return self._last_residual - self._mean

    def update(self, residual: Array, v: Array, known_for: float = math.inf) -> None:
        """Take the external torque of one state.

        Parameters
        ----------
        residual
            External torque (7,), N m.
        v
            Joint velocities (7,), rad/s.
        known_for
            Seconds since the arm was handed over, as the observer counts them; without it, it was long ago.
        """
        self._last_residual = residual
        self._last_velocity = v
        torques, speeds, mean = residual.tolist(), v.tolist(), self._mean
        above = False
        touched = False
        contact_limits = self._release_limits if self.in_contact else self._contact_limits
        joints = zip(torques, speeds, mean, self._stop_limits, contact_limits, strict=True)
        for torque, speed, slow, (threshold, per_speed, sudden_threshold), (contact, contact_per_speed) in joints:
            if speed < 0.0:
                speed = -speed
            more, sudden = per_speed * speed, torque - slow
            contact += contact_per_speed * speed
            # Written so that a residual that is not a number is above, too.
            if not -contact <= sudden <= contact:
                touched = True
                sudden_threshold += more
                above = above or not -sudden_threshold <= sudden <= sudden_threshold
            threshold += more
            if not -threshold <= torque <= threshold:
                above = True
        if known_for < self.budget.handover_time:
            self._hand_over(residual)
            self._follow(torques, _HANDOVER_STATES)
            # Until the slow mean is known, nothing can be called sudden.
            above, touched = above and self._beyond_absolute(residual, v), False
        else:
            self._handed_over_above = 0
            states = self.settings.mean_states
            self._follow(torques, states * _CONTACT_MEMORY if self.in_contact else states)
        self._above = self._above + 1 if above else 0
        if self._above >= self.settings.debounce:
            self.stop(self._explain(residual, v))
        self._debounce_contact(touched)

    def stop(self, reason: str) -> None:
        """Latch a stop; the first reason is kept."""
        if not self.stopped:
            self.stop_reason = reason
            self.stops += 1

    def stop_distrusting(self, reason: str) -> None:
        """Latch a stop because the joint states or the model are wrong; the first such reason is kept."""
        self.stop(reason)
        self.distrust = self.distrust or reason

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
        limits = self.settings.reset_share * np.array(self.budget.torque_thresholds)
        # Not `>`: a residual that is not a number is no reason to let go.
        pushed = ~(np.abs(self._last_residual) <= limits)
        if pushed.any():
            joint = int(np.argmax(np.abs(self._last_residual) / limits))
            raise InputError(
                f"external torque on {iiwa14.JOINT_NAMES[joint]} is {self._last_residual[joint]:.1f} Nm; "
                f"reset needs at most {limits[joint]:g} Nm: free the arm"
            )
        self.stop_reason = self.distrust = ""
        self._above = self._touched = self._handed_over_above = 0
        # What the slow mean took up of the push that stopped the arm would be a sudden torque now.
        self._mean = self._last_residual.tolist()
        self.in_contact = False

    def _scaled_contact_limits(self, share: float) -> list[tuple[float, float]]:
        limits = zip(self.budget.contact_thresholds, self.budget.contact_per_speed, strict=True)
        return [(share * threshold, share * per_speed) for threshold, per_speed in limits]

    def _follow(self, torques: list[float], states: int) -> None:
        """Let the slow mean follow; what is not finite it does not follow."""
        share = 1.0 / states
        mean = [slow + share * (torque - slow) for torque, slow in zip(torques, self._mean, strict=True)]
        if math.isfinite(sum(mean)):
            self._mean = mean

    def _debounce_contact(self, touched: bool) -> None:
        if touched:
            self._untouched = 0
            self._touched += 1
            if not self.in_contact and self._touched >= self.settings.contact_debounce:
                self.in_contact = True
                self.contacts += 1
            return
        self._touched = 0
        self._untouched += 1
        if self._untouched >= self.settings.release_debounce:
            self.in_contact = False

    def _hand_over(self, residual: Array) -> None:
        """At hand-over nothing moves yet: what is seen then is weight that the model does not know."""
        shares = np.abs(residual) / self._handover_limits
        joint = int(np.argmax(shares))
        if shares[joint] <= 1.0:
            self._handed_over_above = 0
            return
        self._handed_over_above += 1
        if self._handed_over_above >= self.settings.handover_debounce:
            # A compliant stop would let the arm sink: it is the model that is to carry it.
            self.stop_distrusting(
                f"at hand-over the external torque on {iiwa14.JOINT_NAMES[joint]} is {residual[joint]:.1f} Nm, "
                f"permitted {self._handover_limits[joint]:g} Nm: the model's gravity or payload does not match the arm"
            )

    def _thresholds(self, v: Array) -> tuple[Array, Array]:
        """Of the external torque and of the sudden one, (7,) N m each."""
        more = np.array(self.budget.torque_per_speed) * np.abs(v)
        return np.array(self.budget.torque_thresholds) + more, np.array(self.budget.sudden_thresholds) + more

    def _beyond_absolute(self, residual: Array, v: Array) -> bool:
        return not (np.abs(residual) <= self._thresholds(v)[0]).all()

    def _explain(self, residual: Array, v: Array) -> str:
        thresholds, sudden_thresholds = self._thresholds(v)
        if self._beyond_absolute(residual, v):
            kind, torques, limits = "external", residual, thresholds
        else:
            kind, torques, limits = "sudden external", self.sudden, sudden_thresholds
        joint = int(np.argmax(np.abs(torques) / limits))
        return (
            f"{kind} torque on {iiwa14.JOINT_NAMES[joint]} is {torques[joint]:.1f} Nm, permitted {limits[joint]:.3g} Nm"
        )
