"""The safety state machine: it reports contact, and latches the stop above the contact budget."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from contact_reach_ros.arm import Array, check_rest
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import in_words
from contact_reach_ros.errors import InputError, StopCode, StopReason
from contact_reach_ros.observer.baseline import Baseline
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.settings import SafetySettings
from contact_reach_ros.timing import states_in


class SafetyLevel(Enum):
    """Assessment of the external torque."""

    FREE = "free"
    CONTACT = "contact"
    """Something touches the arm, within the budget."""
    BLIND = "blind"
    """The external torque cannot be known."""
    COLLISION = "collision"
    """Above the budget, or stopped for another reason: the stop is latched."""


HANDOVER_TIME = 0.3
"""Duration of the hand-over, from the moment the acting torque is known, s: brakes need as long to open."""
HANDOVER_DEBOUNCE = 30
"""Time above a threshold at hand-over that stops the arm, ms: brakes that open let the torque jump for a
moment."""
RELEASE_SHARE = 0.8
"""Share of the contact thresholds below which a contact ends: noise must not end it and begin another."""
RELEASE_DEBOUNCE = 50
"""Time below that share that ends a contact, ms."""


class SafetyMonitor:
    """Watches the external torque; above the budget it latches a stop until `reset`.

    The monitor watches the external torque itself and, with much lower thresholds, its deviation from what an error of
    the model explains, see `Baseline`.

    Attributes
    ----------
    stop_reason
        Why the arm is stopped; empty while it is not.
    distrust
        What is wrong with the joint states or the model, on which a compliant stop relies; empty until something is,
        and after a reset.
    stops
        Number of stops.
    in_contact
        Whether something touches the arm, with hysteresis.
    contacts
        Number of contacts.
    """

    def __init__(
        self, model: RobotModel, settings: SafetySettings, budget: ContactBudget, period: float = 0.001
    ) -> None:
        """Make a monitor that has seen nothing.

        Parameters
        ----------
        model
            Of the arm, see `Baseline`.
        settings, budget
            What is permitted.
        period
            Nominal time between states, s, which turns times into numbers of states.
        """
        arm = model.arm
        budget = budget.resolve(arm)
        self.settings = settings
        self._names = arm.joint_names
        self._weight = f"something pushes it, or the model has a wrong weight; it assumes {in_words(arm)}"
        self._debounce = states_in(settings.debounce, period)
        self._contact_debounce = states_in(settings.contact_debounce, period)
        self._handover_debounce = states_in(HANDOVER_DEBOUNCE, period)
        self._release_debounce = states_in(RELEASE_DEBOUNCE, period)
        self.budget = budget
        self.stop_reason = ""
        self.distrust = ""
        self.stops = 0
        self.in_contact = False
        self.contacts = 0
        self._baseline = Baseline(model, budget.handover_thresholds, budget.contact_thresholds, period)
        self._stop_limits = list(
            zip(budget.torque_thresholds, budget.torque_per_speed, budget.sudden_thresholds, strict=True)
        )
        self._contact_limits = self._scaled_contact_limits(1.0)
        self._release_limits = self._scaled_contact_limits(RELEASE_SHARE)
        self._handover_limits = np.array(budget.handover_thresholds)
        self._above = 0
        self._touched = 0
        self._untouched = 0
        self._handed_over_above = 0
        self._last_residual = np.zeros(arm.n)
        self._last_velocity = np.zeros(arm.n)
        self._last_posture = np.zeros(arm.n)

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return bool(self.stop_reason)

    @property
    def level(self) -> SafetyLevel:
        """Assessment of the external torque at the last state."""
        if self.stop_reason:
            return SafetyLevel.COLLISION
        return SafetyLevel.CONTACT if self.in_contact else SafetyLevel.FREE

    @property
    def sudden(self) -> Array:
        """External torque minus its baseline at the last state, (n,), N m."""
        return self._last_residual - self._baseline.mean

    def update(self, residual: Array, q: Array, v: Array, known_for: float = math.inf) -> None:
        """Take the external torque of one state.

        Parameters
        ----------
        residual
            External torque (n,), N m.
        q, v
            Joint positions (n,) rad and velocities (n,) rad/s.
        known_for
            Seconds since the hand-over, as the observer counts them; by default long ago.
        """
        self._last_residual = residual
        self._last_velocity = v
        # For so few numbers loops over plain floats are faster than NumPy.
        torques, speeds, mean = residual.tolist(), v.tolist(), self._baseline.mean
        self._last_posture = q
        above = False
        touched = False
        contact_limits = self._release_limits if self.in_contact else self._contact_limits
        joints = zip(torques, speeds, mean, self._stop_limits, contact_limits, strict=True)
        for torque, speed, slow, (threshold, per_speed, sudden_threshold), (contact, contact_per_speed) in joints:
            if speed < 0.0:
                speed = -speed
            more, sudden = per_speed * speed, torque - slow
            contact += contact_per_speed * speed
            # Written so that a NaN residual is above, too.
            if not -contact <= sudden <= contact:
                touched = True
                sudden_threshold += more
                above = above or not -sudden_threshold <= sudden <= sudden_threshold
            threshold += more
            if not -threshold <= torque <= threshold:
                above = True
        handed_over = known_for < HANDOVER_TIME
        if handed_over:
            self._hand_over(residual)
            self._baseline.hand_over(residual, q)
            # Until the baseline is known, nothing can be called sudden.
            above, touched = above and self._beyond_absolute(residual, v), False
        else:
            self._handed_over_above = 0
            self._baseline.follow(torques, q, self.in_contact)
        self._above = self._above + 1 if above else 0
        if self._above >= self._debounce:
            reason = self._explain(residual, v)
            self.stop(StopReason(reason.code, f"at hand-over {reason}: {self._weight}") if handed_over else reason)
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

        Raises `InputError` if the arm moves or is still pushed; the stop stays.
        """
        check_rest(self._last_velocity)
        # The arm is handed over again: what refuses a start refuses a reset.
        limits = self._handover_limits
        # Not `>`: a NaN residual is no reason to let go.
        pushed = ~(np.abs(self._last_residual) <= limits)
        if pushed.any():
            joint = int(np.argmax(np.abs(self._last_residual) / limits))
            raise InputError(
                f"external torque on {self._names[joint]} is {self._last_residual[joint]:.1f} Nm; "
                f"reset needs at most {limits[joint]:g} Nm: free the arm"
            )
        self.stop_reason = self.distrust = ""
        self._above = self._touched = self._handed_over_above = 0
        self._baseline.restart(self._last_residual, self._last_posture)
        self.in_contact = False

    def _scaled_contact_limits(self, share: float) -> list[tuple[float, float]]:
        limits = zip(self.budget.contact_thresholds, self.budget.contact_per_speed, strict=True)
        return [(share * threshold, share * per_speed) for threshold, per_speed in limits]

    def _debounce_contact(self, touched: bool) -> None:
        if touched:
            self._untouched = 0
            self._touched += 1
            if not self.in_contact and self._touched >= self._contact_debounce:
                self.in_contact = True
                self.contacts += 1
            return
        self._touched = 0
        self._untouched += 1
        if self._untouched >= self._release_debounce:
            self.in_contact = False

    def _hand_over(self, residual: Array) -> None:
        """At hand-over nothing moves yet: an external torque is weight that the model does not include."""
        shares = np.abs(residual) / self._handover_limits
        joint = int(np.argmax(shares))
        if shares[joint] <= 1.0:
            self._handed_over_above = 0
            return
        self._handed_over_above += 1
        if self._handed_over_above >= self._handover_debounce:
            # A compliant stop would let the arm sink: this model would have to carry it.
            text = (
                f"at hand-over the external torque on {self._names[joint]} is {residual[joint]:.1f} Nm, "
                f"permitted {self._handover_limits[joint]:g} Nm: {self._weight}"
            )
            self.stop_distrusting(StopReason(StopCode.MODEL, text))

    def _thresholds(self, v: Array) -> tuple[Array, Array]:
        """Thresholds of the external torque and of the sudden one, (n,) N m each."""
        more = np.array(self.budget.torque_per_speed) * np.abs(v)
        return np.array(self.budget.torque_thresholds) + more, np.array(self.budget.sudden_thresholds) + more

    def _beyond_absolute(self, residual: Array, v: Array) -> bool:
        return not (np.abs(residual) <= self._thresholds(v)[0]).all()

    def _explain(self, residual: Array, v: Array) -> StopReason:
        thresholds, sudden_thresholds = self._thresholds(v)
        if self._beyond_absolute(residual, v):
            code, kind, torques, limits = StopCode.EXTERNAL_TORQUE, "external", residual, thresholds
        else:
            code, kind, torques, limits = StopCode.SUDDEN_TORQUE, "sudden external", self.sudden, sudden_thresholds
        joint = int(np.argmax(np.abs(torques) / limits))
        text = f"{kind} torque on {self._names[joint]} is {torques[joint]:.1f} Nm, permitted {limits[joint]:.3g} Nm"
        return StopReason(code, text)
