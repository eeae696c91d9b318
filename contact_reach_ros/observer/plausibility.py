"""Plausibility of joint states: positions must fit velocities, and encoders must still see their joint move."""

from __future__ import annotations

import math

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.errors import StopCode, StopReason
from contact_reach_ros.observer.settings import PlausibilitySettings
from contact_reach_ros.observer.sight import PERIODS
from contact_reach_ros.timing import GAP_PERIODS, NANOSECONDS, states_in

_MEMORY = 2.0
"""Time constant with which a difference between position and integrated velocity is forgotten, s."""

FROZEN_TIME = 30
"""Time for which a position may stay the same, to the last bit, while the joint's sudden external torque is that of a
contact, ms; a contact that lasts so long bends the arm by more than an encoder's resolution."""
FROZEN_TORQUE_TIME, FROZEN_TORQUE_WAY = 200, 0.003
"""For how long a measured torque may stay the same, to the last bit, although its joint has moved by so much, ms and
rad."""


_REPEATED = StopReason(
    StopCode.BLIND,
    "blind: joint_states repeat positions, velocities and efforts to the last bit, with new stamps: the driver has "
    "lost the robot, or its sensors are too coarse",
)


class PlausibilityCheck:
    """Detects joint states on which nobody may act, not even to stop the arm softly.

    Three things are impossible. One is a state that repeats itself, as sensors have noise. Another is a position that
    does not follow its velocity: ∫(dq − q̇ dt), with a slow leak, must stay near zero. The last is a position that does
    not change at all while torque acts on the joint: a contact that the momentum observer would hold responsible bends
    the compliant arm by more than an encoder's resolution.
    """

    def __init__(
        self, arm: Arm, settings: PlausibilitySettings, contact_thresholds: tuple[float, ...], period: float = 0.001
    ) -> None:
        """`contact_thresholds`: sudden external torque (n,) that would move a joint, N m; `period`: of states, s."""
        self._names = arm.joint_names
        self._max_step_ns = GAP_PERIODS * round(period * NANOSECONDS)
        self._frozen_states = states_in(FROZEN_TIME, period)
        self._settings = settings
        self._thresholds = contact_thresholds
        self._q: list[float] | None = None
        self._v = [0.0] * arm.n
        self._stamp_ns = 0
        self._slips = [0.0] * arm.n
        self._same = [0] * arm.n
        self._content = b""
        """Positions, velocities and torques of the last state."""
        self._repeats, self._most_repeats = 0, max(PERIODS, self._frozen_states)
        """States that were the same as the last one, to the last bit."""

    def update(self, q: Array, v: Array, torque: Array | None, sudden: Array | None, stamp_ns: int) -> str:
        """Take one state; returns what is wrong with it and those before it, empty while nothing is.

        Parameters
        ----------
        q, v
            Joint positions (n,) rad and velocities (n,) rad/s.
        torque, sudden
            Measured and sudden external torque (n,), N m; None while it is unknown.
        stamp_ns
            Time of the state.
        """
        differs = self._compare(q, v, sudden, stamp_ns)
        content = q.tobytes() + v.tobytes() + (b"" if torque is None else torque.tobytes())
        self._repeats = self._repeats + 1 if torque is not None and content == self._content else 0
        self._content = content
        return differs if self._repeats < self._most_repeats else _REPEATED

    def _compare(self, q: Array, v: Array, sudden: Array | None, stamp_ns: int) -> str:
        positions, speeds = q.tolist(), v.tolist()
        previous, last_speeds, elapsed_ns = self._q, self._v, stamp_ns - self._stamp_ns
        self._q, self._v, self._stamp_ns = positions, speeds, stamp_ns
        if previous is None or not 0 < elapsed_ns <= self._max_step_ns:
            self._slips = [0.0] * len(positions)
            return ""
        elapsed = elapsed_ns / NANOSECONDS
        keep, half = math.exp(-elapsed / _MEMORY), 0.5 * elapsed
        # For so few numbers loops over plain floats are faster than NumPy.
        for joint, (now, before, speed, last) in enumerate(zip(positions, previous, speeds, last_speeds, strict=True)):
            self._slips[joint] = keep * self._slips[joint] + now - before - half * (speed + last)
            self._same[joint] = self._same[joint] + 1 if now == before else 0
        for joint, slip in enumerate(self._slips):
            if not -self._settings.position_slip <= slip <= self._settings.position_slip:
                return StopReason(
                    StopCode.ENCODER,
                    f"position and velocity of {self._names[joint]} differ by {slip:.3f} rad, permitted "
                    f"{self._settings.position_slip:g} rad: look at its encoder",
                )
        if sudden is None or max(self._same) < self._frozen_states:
            return ""
        for joint, (states, torque) in enumerate(zip(self._same, sudden.tolist(), strict=True)):
            if states >= self._frozen_states and abs(torque) > self._thresholds[joint]:
                return StopReason(
                    StopCode.ENCODER,
                    f"the position of {self._names[joint]} has not changed for {states} states under a sudden "
                    f"external torque of {torque:.1f} Nm: its encoder is stuck, or the joint blocked",
                )
        return ""


class TorqueCheck:
    """Watches for torque sensors that report a constant although their joint moves.

    Friction, gravity and inertia change the torque of a joint that moves, and every sensor has noise.
    """

    def __init__(self, arm: Arm, period: float = 0.001) -> None:
        """`period`: nominal time between states, s."""
        self._names = arm.joint_names
        self._states = states_in(FROZEN_TORQUE_TIME, period)
        self._last = [math.nan] * arm.n
        self._same = [0] * arm.n
        self._from = [0.0] * arm.n
        """Where the joint was when its torque last changed, rad."""

    def update(self, q: Array, torque: Array | None) -> str:
        """Take one state; which sensor is stuck, empty while none is.

        Parameters
        ----------
        q
            Joint positions (n,), rad.
        torque
            Measured torques (n,), N m; None while they are unknown.
        """
        if torque is None:
            self._last = [math.nan] * len(self._last)
            return ""
        torques, positions = torque.tolist(), q.tolist()
        for joint, (now, before) in enumerate(zip(torques, self._last, strict=True)):
            self._same[joint] += 1
            if now != before:
                self._same[joint], self._from[joint] = 0, positions[joint]
        self._last = torques
        if max(self._same) < self._states:
            return ""
        for joint, (states, begin) in enumerate(zip(self._same, self._from, strict=True)):
            moved = abs(positions[joint] - begin)
            if states >= self._states and moved > FROZEN_TORQUE_WAY:
                return StopReason(
                    StopCode.TORQUE_SENSOR,
                    f"the torque of {self._names[joint]} has been {torques[joint]:.2f} Nm for {states} states although "
                    f"it has moved by {moved:.3f} rad: look at its torque sensor",
                )
        return ""
