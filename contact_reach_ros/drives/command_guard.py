"""A watchdog over commands on their way to a drive that has none, and would hold the last torque for ever."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum

import numpy as np

from contact_reach_ros.arm import REST_SPEED, Arm, Array, JointState, check_fresh, check_rest, checked_torque
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.passive_stop import PassiveStop
from contact_reach_ros.drives.settings import AdapterSettings
from contact_reach_ros.errors import InputError, StopCode, StopReason
from contact_reach_ros.timing import NANOSECONDS

COMMANDS = "adapter/commands"
"""Topic that refusals name."""
HOLD_AFTER = 0.02
"""Time without a command after which harmless torques are sent, s; at low rates two periods of the joint states."""
STOP_AFTER = 0.1
"""Time without a command after which none is passed on until `reset`, s."""
RESUME_RAMP = 0.5
"""Time in which commands reach full authority after a silence, s, as the controller's laws at its start."""


class Phase(Enum):
    """What is sent to the drive."""

    WAITING = "waiting"
    """Nothing: there has been no command yet."""
    PASSING = "passing"
    """The commands."""
    HARMLESS = "harmless"
    """Harmless torques: commands are silent, the guard is stopped, or the drive is being checked."""


class CommandGuard:
    """Passes commands on, and sends harmless torques while there are none.

    After `HOLD_AFTER` without a command, the harmless torques are those of the compliant stop: gravity compensation and
    damping, without damping while the joint states are silent, too. If they last until `STOP_AFTER`, a stop is latched
    until `reset`. After a silence commands get their authority back within `RESUME_RAMP`.

    Times `clock_ns` are integer nanoseconds of the watchdogs' clock, which must never jump. When nobody called `watch`
    for long, because the process stood still, the latch waits for its time of harmless torques nevertheless: then it is
    not known whether the commands were silent.

    Attributes
    ----------
    phase
        What is sent.
    stop_reason
        Why no command is passed on; empty while they are.
    """

    def __init__(
        self, arm: Arm, settings: AdapterSettings, period: float = 0.001, hold: Sequence[float] | None = None
    ) -> None:
        """Set up the guard, which sends nothing yet.

        Parameters
        ----------
        arm, settings
            Arm and settings.
        period
            Nominal time between joint states, s.
        hold
            Torque (n,) up to which harmless torques hold a joint, N m; the hand-over limits of the arm by default.
        """
        self.phase = Phase.WAITING
        self.stop_reason = ""
        self._arm = arm
        self._model = RobotModel(arm)
        constants = make_constants(arm, limits=settings.limits, supervision=settings.stop, period=period, hold=hold)
        self._stop = PassiveStop(arm, constants)
        self._period = period
        self._hold_ns = round(max(HOLD_AFTER, 2.0 * period) * NANOSECONDS)
        self._stop_ns = round(STOP_AFTER * NANOSECONDS)
        self._ramp_ns = round(RESUME_RAMP * NANOSECONDS)
        self._repeat_ns = round(2.0 * period * NANOSECONDS)
        self._state: JointState | None = None
        self._seen_ns = 0
        self._is_new = False
        """Whether the last joint state has not been answered with a harmless torque."""
        self._commanded_ns = 0
        self._resumed_ns: int | None = None
        """When commands came back after a silence; None if there was none."""
        self._harmless_ns: int | None = None
        """When the commands became silent; None after a stop or reset, since when they may come at any time."""
        self._sent = self._last_harmless = np.zeros(arm.n)
        self._sent_ns = 0

    def see(self, state: JointState, clock_ns: int) -> None:
        """Take a joint state, finite, that arrived at `clock_ns`."""
        self._state, self._seen_ns, self._is_new = state, clock_ns, True

    def command(self, torque: Array, clock_ns: int) -> Array | None:
        """Take a command (n,), N m; returns what to send for it, None while stopped.

        Raises
        ------
        InputError
            If it has the wrong size, is not finite or above the arm's torque limits, or there was no joint state yet.
            It counts as silence.
        """
        checked_torque(torque, self._arm.n, COMMANDS)
        if (np.abs(torque) > self._arm.torque_limits).any():
            raise InputError(
                f"{COMMANDS}: data = {torque.tolist()}; expected at most {self._arm.torque_limits.tolist()} Nm"
            )
        if self._state is None:
            raise InputError("no joint state yet: nothing is passed on, as nothing could be sent in its place")
        if self.stop_reason:
            return None
        if self.phase is Phase.PASSING and self._is_silent(clock_ns):
            self._begin_harmless(clock_ns)
        if self.phase is Phase.HARMLESS:
            self._resumed_ns = clock_ns
        self.phase = Phase.PASSING
        self._commanded_ns = clock_ns
        if self._resumed_ns is not None:
            since_ns = clock_ns - self._resumed_ns
            if since_ns < self._ramp_ns:
                share = since_ns / self._ramp_ns
                torque = share * torque + (1.0 - share) * self._harmless(clock_ns)
            else:
                self._resumed_ns = None
        self._sent = torque
        return torque

    def hold(self) -> None:
        """Send harmless torques until a command is passed on, although none has been yet."""
        if self.phase is Phase.WAITING and self._state is not None:
            self._begin_harmless(None)

    def watch(self, clock_ns: int) -> Array | None:
        """Look for silence; returns the harmless torque (n,), N m, to send now, None if there is nothing to send."""
        if self.phase is Phase.PASSING and self._is_silent(clock_ns):
            self._begin_harmless(clock_ns)
        if self.phase is not Phase.HARMLESS:
            return None
        if self._harmless_ns is not None and clock_ns - self._harmless_ns > self._stop_ns - self._hold_ns:
            text = f"no command for {(clock_ns - self._commanded_ns) / 1e6:.0f} ms"
            if clock_ns - self._seen_ns > self._hold_ns:
                text += f", nothing on joint_states for {(clock_ns - self._seen_ns) / 1e6:.0f} ms: see the driver"
            self.stop(StopReason(StopCode.NO_COMMAND, text))
        if not self._is_new and clock_ns - self._sent_ns < self._repeat_ns:
            return None
        self._is_new, self._sent_ns = False, clock_ns
        self._sent = self._harmless(clock_ns)
        return self._sent

    def due_ns(self, clock_ns: int, idle_ns: int) -> int:
        """Time until joint states are to be looked for, and `watch` called, if no command comes; at most `idle_ns`."""
        if self.phase is Phase.WAITING:
            return idle_ns
        if self.phase is Phase.HARMLESS:
            # Soon after each state: damping by an old one would be less stable.
            return self._repeat_ns // 4
        return min(max(self._commanded_ns + self._hold_ns + 1 - clock_ns, 0), idle_ns)

    @property
    def rests(self) -> bool:
        """Whether the arm is at rest by the last joint state; also before the first."""
        return self._state is None or bool(np.abs(self._state.v).max() <= REST_SPEED)

    def stop(self, reason: str) -> None:
        """Pass no more commands on until `reset`; the first reason is kept."""
        self.stop_reason = self.stop_reason or reason
        if self.phase is Phase.PASSING:
            self._begin_harmless(None)

    def reset(self, clock_ns: int) -> None:
        """Release a stop: harmless torques are sent until the next command.

        Raises `InputError` if the arm moves, or its last joint state is too old to tell; the stop stays.
        """
        if self._state is None:
            raise InputError("no joint state yet: reset needs to see the arm at rest")
        check_fresh((clock_ns - self._seen_ns) / NANOSECONDS)
        check_rest(self._state.v)
        self.stop_reason = ""
        self._harmless_ns = None

    def rehearse(self) -> None:
        """Run through every step once, with a guard that is not used for anything else."""
        self.see(JointState(1, np.array(self._arm.home), np.zeros(self._arm.n), None), 1)
        self.command(np.zeros(self._arm.n), 1)
        self.watch(1 + self._stop_ns)

    def _is_silent(self, clock_ns: int) -> bool:
        return clock_ns - self._commanded_ns > self._hold_ns

    def _begin_harmless(self, clock_ns: int | None) -> None:
        """Send harmless torques from now on, which continue from the last torque; `clock_ns`: see `_harmless_ns`."""
        self.phase, self._harmless_ns = Phase.HARMLESS, clock_ns
        self._last_harmless = self._sent
        self._stop.begin()

    def _harmless(self, clock_ns: int) -> Array:
        """The torque of the compliant stop (n,), N m, from the last joint state; it may follow the last such torque."""
        assert self._state is not None
        # Damping by an old velocity would drive the arm.
        damps = clock_ns - self._seen_ns <= self._hold_ns
        torque = self._stopping_torque(self._state.q, self._state.v) if damps else None
        if torque is None or math.isnan(torque[0]):
            torque = self._stopping_torque(self._state.q, np.zeros(self._arm.n))
        self._last_harmless = torque
        return torque

    def _stopping_torque(self, q: Array, v: Array) -> Array:
        self._model.update(q, v)
        return self._stop.torque(self._model, q, v, self._last_harmless, self._period)
