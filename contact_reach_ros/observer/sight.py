"""Whether the external torque can be relied on: blind means stop, and doubt means that nothing is started."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.stop_reasons import StopCode, StopReason
from contact_reach_ros.timing import GAPS_IN_A_ROW, RateCheck, states_in
from contact_reach_ros.units import NANOSECONDS

TAKEN_OVER = 100
"""Time for which a moving arm may come without torques, ms: its drive holds it, and either gives it back or brakes."""

REST_SPEED = 0.05
"""Joint speed, rad/s, up to which torques may be unknown: the brakes are closed."""


class Sight:
    """Counts the joint states in a row from which no external torque follows.

    Torques may be unknown while the arm rests: its brakes are closed, and nobody has been handed the arm. They may be
    unknown for `TAKEN_OVER` while it moves. Anything else that leaves the residual as it was for `GAPS_IN_A_ROW` states
    is blindness.

    Attributes
    ----------
    blind
        Why the external torque cannot be known; empty while it can, or while the arm rests behind its brakes.
    doubt
        Why the arm must not be started; empty when it may.
    rate
        Compares the stamps of the states with the nominal rate.
    """

    def __init__(self, arm: Arm, period: float) -> None:
        """`period`: nominal time between joint states, s."""
        self.blind = ""
        self.doubt = "no joint state with a torque yet"
        self.rate = RateCheck(period)
        self._names = arm.joint_names
        self._taken_over = states_in(TAKEN_OVER, period)
        self._unseen = 0
        self._repeated = 0
        self._has_advanced = False

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
        self._repeated = 0
        self._has_advanced = self._has_advanced or self.rate.steps > 0
        self.rate.update(stamp_ns)
        if seen:
            self._unseen, self.blind = 0, ""
            self.doubt = self.rate.mismatch()
            return
        speed = float(np.abs(v).max())
        if not known and not missing and speed <= REST_SPEED:
            self._unseen, self.blind, self.doubt = 0, "", ""
            return
        self._unseen += 1
        if self._unseen >= (GAPS_IN_A_ROW if known or missing else self._taken_over):
            if missing or not known:
                self._lose(missing or self._explain_motion(v))
            else:
                self._lose(self._explain_gaps(), StopCode.MISSED_STATES)

    def repeated(self) -> bool:
        """Take a state whose stamp is not new; returns whether the stamps have stopped."""
        self._repeated += 1
        # The first state may come again and again, until everybody has received it.
        if self._repeated < 4 * GAPS_IN_A_ROW or not self._has_advanced:
            return False
        self._lose("the stamps of joint_states do not advance: look at the driver's clock")
        return True

    def _lose(self, why: str, code: StopCode = StopCode.BLIND) -> None:
        self.blind = self.doubt = StopReason(code, f"blind: {why}")

    def _explain_motion(self, v: Array) -> str:
        joint = int(np.abs(v).argmax())
        return (
            f"no torque is known while {self._names[joint]} moves with {abs(v[joint]):.2f} rad/s: let the driver "
            "fill effort, or set torque_source to commanded"
        )

    def _explain_gaps(self) -> str:
        return self.rate.mismatch(least=2) or (
            f"joint states are up to {self.rate.longest_ns / NANOSECONDS * 1000:.0f} ms apart, too far for the "
            "external torque: look at the driver and the network"
        )
