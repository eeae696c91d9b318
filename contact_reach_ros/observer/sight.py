"""Whether the external torque can be relied on: blind means stop, and doubt means that nothing is started."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm import BLIND_AFTER, REST_SPEED, Array, check_fresh
from contact_reach_ros.errors import InputError, StopCode, StopReason
from contact_reach_ros.timing import GAP_PERIODS, NANOSECONDS, PAUSE

STILL = 20
"""So many states whose stamp is not new mean that the stamps have stopped."""
PERIODS = 4
"""Least number of periods without a usable state that count as blindness."""
_GAPS = (
    "no two joint states of late are near enough, by their stamps, for the external torque: look at the driver, its "
    "clock and the network"
)
"""Without numbers, as all reasons: each new one is published, logged and recorded."""
FORGIVENESS = 0.2
"""Share of the time with usable states that makes up for time without: gaps that return soon add up to blindness."""


class RateCheck:
    """Compares the stamps of joint states with the nominal rate, over about the last second.

    Attributes
    ----------
    steps
        Steps from state to state that were taken into account, at most those of a second.
    mean_ns
        Mean step, ns.
    """

    TOLERANCE = 0.5
    """How far the mean step may be from the nominal one, as a share of it."""
    _LEAST = 5
    """Steps without which nothing can be concluded."""

    def __init__(self, period: float) -> None:
        """`period`: nominal time between states, s."""
        self.steps = 0
        self.mean_ns = period * NANOSECONDS
        self._period_ns = period * NANOSECONDS
        self._window = max(self._LEAST, round(1.0 / period))
        self._stamp_ns: int | None = None

    def update(self, stamp_ns: int) -> None:
        """Take the stamp of a new state, ns; pauses and steps backwards are no steps."""
        previous, self._stamp_ns = self._stamp_ns, stamp_ns
        if previous is None or not 0 < stamp_ns - previous <= max(PAUSE * NANOSECONDS, 5 * self._period_ns):
            return
        self.steps = min(self.steps + 1, self._window)
        self.mean_ns += (stamp_ns - previous - self.mean_ns) / self.steps

    @property
    def frequency(self) -> float:
        """Mean rate of the states, Hz; NaN before the first step."""
        return NANOSECONDS / self.mean_ns if self.steps else float("nan")

    def mismatch(self, least: int = _LEAST) -> str:
        """In what way the states do not come at the nominal rate; empty when they do, or before `least` steps."""
        if self.steps < least or abs(self.mean_ns / self._period_ns - 1.0) <= self.TOLERANCE:
            return ""
        # A rate that hardly changes is no new reason.
        rate = float(f"{self.frequency:.2g}")
        return (
            f"joint states come at {rate:.0f} Hz, expected {NANOSECONDS / self._period_ns:.0f} Hz: set the "
            "parameter state_rate of all nodes to the driver's, or remap joint_states to a topic that has them all, as "
            "franka/joint_states of franka_ros2"
        )


class Sight:
    """Watches for how long no external torque has followed from the joint states of late; for too long is blindness.

    Torques may be unknown while the arm rests: its brakes are closed, and nobody has been handed the arm.

    Attributes
    ----------
    blind
        Why the external torque cannot be known; empty while it can, or while the arm rests behind its brakes.
    doubt
        Why the arm must not be started; empty when it may.
    rate
        Compares the stamps of the states with the nominal rate.
    """

    def __init__(self, period: float, blind_after: float) -> None:
        """`period`: nominal time between joint states, s; `blind_after`: time without a usable one, s."""
        self.blind = ""
        self.doubt = "no joint state with a torque yet"
        self.rate = RateCheck(period)
        self._limit_ns = round(max(blind_after, PERIODS * period) * NANOSECONDS)
        self._dark_ns = 0
        """Time since the last usable state. By the steps of the stamps, which a clock that is set back cannot undo."""
        self._unseen_ns = 0.0
        """Time of earlier gaps that is not made up for."""
        self._period_ns = round(period * NANOSECONDS)
        self._gap_ns = GAP_PERIODS * period * NANOSECONDS
        self._torque_ns: int | None = None
        """Stamp of the last state that a torque followed from."""
        self._lapse_ns = round(max(BLIND_AFTER, PERIODS * period) * NANOSECONDS)
        self._stamp_ns = 0
        """Stamp of the last new state."""
        self._repeated = 0

    def advanced(self, stamp_ns: int, v: Array, seen: bool, missing: str, known: bool) -> None:
        """Take a new state.

        Parameters
        ----------
        stamp_ns
            Of the state, ns.
        v
            Joint velocities (n,), rad/s.
        seen
            Whether the residual was updated.
        missing
            Why a torque that should be known is not; empty otherwise.
        known
            Whether the state came with a torque for each joint.
        """
        if self._stamp_ns:
            self._dark_ns += stamp_ns - self._stamp_ns if stamp_ns > self._stamp_ns else self._period_ns
        self._repeated, self._stamp_ns = 0, stamp_ns
        self.rate.update(stamp_ns)
        if seen:
            self._torque_ns = stamp_ns
        if seen or (not known and not missing and float(np.abs(v).max()) <= REST_SPEED):
            more_ns = self._dark_ns if self._dark_ns > self._gap_ns else -FORGIVENESS * self._dark_ns
            self._unseen_ns = min(max(self._unseen_ns + more_ns, 0.0), self._limit_ns)
            self._dark_ns, self.blind, self.doubt = 0, "", self.rate.mismatch()
            return
        unseen_ns = self._unseen_ns + self._dark_ns
        if unseen_ns > self._limit_ns:
            if missing or not known:
                self._lose(missing or "no torque is known while the arm moves: let the driver fill effort")
            else:
                self._lose(self.rate.mismatch(least=2) or _GAPS, StopCode.MISSED_STATES)

    def sees(self, stamp_ns: int) -> bool:
        """Whether a torque followed from a state so short a time ago that the brakes can hardly be closed."""
        return self._torque_ns is not None and 0 <= stamp_ns - self._torque_ns <= self._lapse_ns

    def repeated(self) -> bool:
        """Take a state whose stamp is not new; returns whether the stamps have stopped."""
        self._repeated += 1
        if self._repeated < STILL:
            return False
        self._lose("the stamps of joint_states do not advance: look at the driver's clock")
        return True

    def check_fresh(self, silence: float) -> None:
        """Raise `InputError` unless there is a usable state of late; `silence`: time since the last new one came, s."""
        if self.blind or not self._stamp_ns:
            raise InputError(self.blind or self.doubt)
        check_fresh(self._dark_ns / NANOSECONDS + silence)

    def _lose(self, why: str, code: StopCode = StopCode.BLIND) -> None:
        self.blind = self.doubt = StopReason(code, f"blind: {why}")
