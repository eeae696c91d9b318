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
from contact_reach_ros.timing import Debounce


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
        self._names = arm.joint_names
        self._weight = f"something pushes it, or the model has a wrong weight; it assumes {in_words(arm)}"
        self._above = Debounce(settings.debounce, period)
        self._touched = Debounce(settings.contact_debounce, period)
        self._released = Debounce(RELEASE_DEBOUNCE, period)
        self._overweight = Debounce(HANDOVER_DEBOUNCE, period)
        self.budget = budget
        self.stop_reason = ""
        self.distrust = ""
        self.stops = 0
        self.in_contact = False
        self.contacts = 0
        self._baseline = Baseline(model, budget.handover_thresholds, period)
        self._stop_limits = list(
            zip(budget.torque_thresholds, budget.torque_per_speed, budget.sudden_thresholds, strict=True)
        )
        self._contact_limits = self._scaled_contact_limits(1.0)
        self._release_limits = self._scaled_contact_limits(RELEASE_SHARE)
        self._handover_limits = np.array(budget.handover_thresholds)
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

    @property
    def since_handover(self) -> Array:
        """External torque minus that at the hand-over or reset, (n,), N m: without a baseline that follows it."""
        return self._last_residual - self._baseline.anchor

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
        pushed = jumped = touched = False
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
                jumped = jumped or not -sudden_threshold <= sudden <= sudden_threshold
            threshold += more
            pushed = pushed or not -threshold <= torque <= threshold
        handed_over = known_for < HANDOVER_TIME
        if handed_over:
            self._hand_over(residual)
            self._baseline.hand_over(residual, q)
            # Until the baseline is known, nothing can be called sudden.
            jumped = touched = False
        else:
            self._overweight.lasts(False)
            self._baseline.follow(residual, q, self.in_contact)
        if self._above.lasts(pushed or jumped):
            reason = self._explain(pushed, residual, v)
            self.stop(StopReason(reason.code, f"at hand-over {reason}: {self._weight}") if handed_over else reason)
        if self._touched.lasts(touched) and not self.in_contact:
            self.in_contact = True
            self.contacts += 1
        if self._released.lasts(not touched):
            self.in_contact = False

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
        for debounce in (self._above, self._touched, self._overweight):
            debounce.lasts(False)
        self._baseline.restart(self._last_residual, self._last_posture)
        self.in_contact = False

    def _scaled_contact_limits(self, share: float) -> list[tuple[float, float]]:
        limits = zip(self.budget.contact_thresholds, self.budget.contact_per_speed, strict=True)
        return [(share * threshold, share * per_speed) for threshold, per_speed in limits]

    def _hand_over(self, residual: Array) -> None:
        """At hand-over nothing moves yet: an external torque is weight that the model does not include."""
        shares = np.abs(residual) / self._handover_limits
        joint = int(np.argmax(shares))
        if self._overweight.lasts(not shares[joint] <= 1.0):
            # A compliant stop would let the arm sink: this model would have to carry it.
            text = (
                f"at hand-over the external torque on {self._names[joint]} is {residual[joint]:.1f} Nm, "
                f"permitted {self._handover_limits[joint]:g} Nm: {self._weight}"
            )
            self.stop_distrusting(StopReason(StopCode.MODEL, text))

    def _explain(self, pushed: bool, residual: Array, v: Array) -> StopReason:
        """Why the arm is stopped: the external torque itself, or else the sudden one, is above its threshold."""
        more = np.array(self.budget.torque_per_speed) * np.abs(v)
        if pushed:
            code, kind, torques = StopCode.EXTERNAL_TORQUE, "external", residual
            limits = np.array(self.budget.torque_thresholds) + more
        else:
            code, kind, torques = StopCode.SUDDEN_TORQUE, "sudden external", self.sudden
            limits = np.array(self.budget.sudden_thresholds) + more
        joint = int(np.argmax(np.abs(torques) / limits))
        text = f"{kind} torque on {self._names[joint]} is {torques[joint]:.1f} Nm, permitted {limits[joint]:.3g} Nm"
        return StopReason(code, text)
