"""The observer: from joint states to external torques, contacts and stops."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import InputError, Verdict
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import Contact, ContactLocator
from contact_reach_ros.observer.momentum import MomentumObserver
from contact_reach_ros.observer.plausibility import PlausibilityCheck, TorqueCheck
from contact_reach_ros.observer.safety import SafetyLevel, SafetyMonitor
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.observer.sight import Sight
from contact_reach_ros.timing import NANOSECONDS, Debounce, StampOrder

HEARTBEAT = 0.01
"""Longest time between reports that must be passed on, s."""
LEAST_FORCE = 5.0
"""Least force of a contact that counts, N: above the errors of the estimate where contacts are located."""
EXCESS_FORCE, EXCESS_TIME = 3.0, 200
"""Force beyond the permitted one, N, and time for which a contact may have more, ms: an impact is over by then."""


class SafetyReport(NamedTuple):
    """The observer's conclusions from one joint state.

    Attributes
    ----------
    stamp_ns
        Stamp of the state, ns.
    level
        Free, in contact, or stopped.
    verdict
        What the controller has to know. The observer latches what it has seen, but not that it sees nothing.
    residual
        External torque (n,), N m.
    age
        Time since the state that the residual is from, s; infinite before the first.
    contact
        Where the arm is touched, rounded to 1 mm and 0.1 N; None without a located contact.
    has_news
        Whether the level has changed, or a reason, distrust or doubt.
    due
        Whether the report must be passed on, as news or a heartbeat; others need not be.
    """

    stamp_ns: int
    level: SafetyLevel
    verdict: Verdict
    residual: Array
    age: float
    contact: Contact | None
    has_news: bool
    due: bool


def describe_contact(contact: Contact | None) -> str:
    """Force and link of a contact that counts; empty without one."""
    if contact is None or contact.strength < LEAST_FORCE:
        return ""
    return f"{contact.strength:.0f} N at {contact.link}"


class Observer:
    """Momentum observer, safety monitor, plausibility check and contact location, in that order, for each joint state.

    Attributes
    ----------
    contact
        Contact of the last heartbeat; None while nothing touches the arm.
    updates
        Number of new, accepted states.
    order
        Counts repeated and late states.
    sight
        Whether the external torque can be relied on.
    """

    def __init__(
        self,
        arm: Arm,
        settings: ObserverSettings,
        budget: ContactBudget,
        period: float = 0.001,
        locates: bool = True,
        blind_after: float = 0.25,
    ) -> None:
        """Make an observer that has seen nothing.

        Parameters
        ----------
        arm, settings, budget
            What to observe, and how.
        period
            Nominal time between joint states, s.
        locates
            Whether to locate contacts, which takes longer than everything else.
        blind_after
            Time without a state that an external torque follows from, after which it is blind, s.
        """
        budget = budget.resolve(arm)
        momentum = settings.momentum.resolve(arm)
        self.arm = arm
        shifted = arm.with_center_shifts(momentum.center_shift_x, momentum.center_shift_y)
        model = RobotModel(shifted)
        self.momentum = MomentumObserver(settings.momentum, model, period)
        self.monitor = SafetyMonitor(model, settings.safety, budget, period)
        self.contact: Contact | None = None
        self.updates = 0
        self.order = StampOrder()
        self.sight = Sight(period, blind_after)
        self._plausibility = PlausibilityCheck(arm, settings.plausibility, budget.contact_thresholds, period)
        self._torque_check = TorqueCheck(arm, period)
        self._locator = ContactLocator(model, budget.contact_thresholds)
        self._locates = locates
        self._torque_known = False
        """Whether the last states came with torques, after the first of them."""
        self._permitted = budget.permitted_force + EXCESS_FORCE
        self._heartbeat_every = max(1, round(HEARTBEAT / period))
        self._excess = Debounce(EXCESS_TIME, period * self._heartbeat_every)
        self._reported: tuple[SafetyLevel, str, str, str] | None = None

    def update(self, state: JointState) -> SafetyReport | None:
        """Take one state; returns the conclusions from it, or None for a state that is not new.

        Raises
        ------
        InputError
            If a position or velocity is not finite; the residual stays as it is.
        """
        stamp_ns, q, v, _ = state
        # A sum is finite exactly when every summand is; for so few numbers Python is faster than NumPy.
        if not math.isfinite(sum(q.tolist()) + sum(v.tolist())):
            raise InputError(f"joint_states: position and velocity must be finite, got {q.tolist()}, {v.tolist()}")
        if not self.order.is_new(stamp_ns):
            return self._conclude(stamp_ns, is_heartbeat=True) if self.sight.repeated() else None
        torque, missing = self._known_torque(state.torque, stamp_ns)
        momentum, monitor = self.momentum, self.monitor
        if missing:
            # The next state is compared with the last good one: this is no hand-over.
            momentum.refused += 1
        else:
            momentum.update(q, v, torque, stamp_ns)
            # Not after a pause, which is no reason to doubt the drive.
            self._torque_known = torque is not None and (self._torque_known or momentum.known_for > 0.0)
        self.sight.advanced(stamp_ns, v, momentum.updated_ns == stamp_ns, missing, torque is not None)
        monitor.update(momentum.residual, q, v, momentum.known_for)
        wrong = self._plausibility.update(q, v, torque, monitor.sudden, stamp_ns)
        if wrong:
            monitor.stop_distrusting(wrong)
        stuck = self._torque_check.update(q, torque)
        if stuck:
            monitor.stop(stuck)
        self.updates += 1
        is_heartbeat = self.updates % self._heartbeat_every == 0
        if is_heartbeat:
            contact = self.locate(q) if self._locates and monitor.in_contact else None
            is_excessive = self._excess.lasts(contact is not None and contact.least > self._permitted)
            self.contact = contact and dataclasses.replace(contact, is_excessive=is_excessive)
        return self._conclude(stamp_ns, is_heartbeat)

    def report(self, stamp_ns: int = 0, is_heartbeat: bool = False) -> SafetyReport:
        """The present state of the observer as a report."""
        monitor, momentum, sight = self.monitor, self.momentum, self.sight
        level, reason = monitor.level, monitor.stop_reason
        if sight.blind and not reason:
            level, reason = SafetyLevel.BLIND, sight.blind
        contact, updated_ns = self.contact, momentum.updated_ns
        verdict = Verdict(
            reason,
            monitor.distrust,
            reason or sight.doubt,
            self._torque_known,
            describe_contact(contact),
            contact is not None and contact.is_excessive,
        )
        age = math.inf if updated_ns is None else max(stamp_ns - updated_ns, 0) / NANOSECONDS
        has_news = (level, *verdict[:3]) != self._reported
        return SafetyReport(
            stamp_ns, level, verdict, momentum.residual, age, contact, has_news, has_news or is_heartbeat
        )

    def _conclude(self, stamp_ns: int, is_heartbeat: bool) -> SafetyReport:
        report = self.report(stamp_ns, is_heartbeat)
        self._reported = report.level, *report.verdict[:3]
        return report

    def locate(self, q: Array) -> Contact:
        """The contact that best explains the sudden external torque at joint positions `q` (n,), rad, rounded.

        The baseline may have taken for an error of the model what was contact that grew slowly, and the rest of that
        contact may look like a much stronger one: `Contact.least` counts the torque since the hand-over, too.
        """
        return self._locator.locate(q, self.monitor.sudden, self.monitor.since_handover).rounded()

    def rehearse(self) -> None:
        """Run through every step once, with an observer that is not used for anything else.

        Work that libraries do at their first call must not happen while an arm waits.
        """
        zero, home = np.zeros(self.arm.n), np.array(self.arm.home)
        for stamp_ns in (0, 1_000_000):
            self.update(JointState(stamp_ns, home, zero, zero))
        self.momentum.flange_wrench()
        self.locate(home)

    def stop(self, reason: str) -> None:
        """Latch a stop for a reason outside the joint states."""
        self.monitor.stop(reason)

    def reset(self, silence: float) -> None:
        """Release a stop. Where the acting torque is unknown, behind closed brakes, the hand-over decides afterwards.

        `silence`: time since the last new state came, s.

        Raises
        ------
        InputError
            If the arm moves or is still pushed, or what is known of it is too old; the stop stays.
        """
        self.sight.check_fresh(silence)
        self.monitor.reset()

    def _known_torque(self, measured: Array | None, stamp_ns: int) -> tuple[Array | None, str]:
        """The measured torque (n,), N m, None while it is unknown; and why, unless the brakes may be closed."""
        if measured is None:
            return None, "joint_states carry no effort: let the driver fill it"
        if math.isfinite(sum(measured.tolist())):
            return measured, ""
        unknown = ~np.isfinite(measured)
        if np.isnan(measured).all():
            # Brakes stay closed for longer than a sensor may fail.
            return None, "joint_states carry no finite effort at times" if self.sight.sees(stamp_ns) else ""
        names = ", ".join(name for name, lacks in zip(self.arm.joint_names, unknown, strict=True) if lacks)
        return None, f"joint_states carry no finite effort for {names}: look at the driver's torque sensors"
