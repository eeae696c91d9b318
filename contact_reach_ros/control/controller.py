"""The controller: laws, limits and supervision, one tick per joint state."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.law import ImpedanceLaw, Reference, pose_error
from contact_reach_ros.control.limits import JointLimitRepulsion, TorqueLimiter
from contact_reach_ros.control.reference import ReferenceQueue, blend
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ControllerSettings:
    """All settings of the controller, by section."""

    impedance: ImpedanceSettings = field(default_factory=ImpedanceSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    supervision: SupervisionSettings = field(default_factory=SupervisionSettings)


class Mode(Enum):
    """What the controller does."""

    HOLDING = "holding"
    """No valid plan: the arm is held where it is."""
    TRACKING = "tracking"
    """A plan is in force."""
    STOPPED = "stopped"
    """Latched compliant stop: no stiffness, damping and gravity only."""


_PAUSE_NS = 5_000_000
"""Ticks further apart than this show that the controller itself was held up."""

_NOWHERE = Reference(np.zeros(3), np.eye(3), np.zeros(iiwa14.N_JOINTS))
"""Stands where there is no reference yet."""


class Controller:
    """Turns joint states and plans into torques.

    `start` once, then `tick` for every joint state. Times are integer nanoseconds of the clock that stamps joint states
    and plans; `clock_ns` is the clock of the watchdogs, which must never jump (the steady clock on a robot).
    """

    def __init__(self, settings: ControllerSettings, model: RobotModel) -> None:
        self.settings = settings
        self.model = model
        self.law = ImpedanceLaw(settings.impedance)
        self.repulsion = JointLimitRepulsion(settings.limits)
        self.limiter = TorqueLimiter(settings.limits)
        self.references = ReferenceQueue(settings.supervision.max_plan_lead)
        self.mode = Mode.HOLDING
        self.stop_reason = ""
        self.error = np.zeros(6)
        """Δx of the last tick, (6,), m and rad."""
        self._started = False
        self._hold = self._blend_from = self._last_reference = _NOWHERE
        self._hold_since_ns = 0
        self._started_ns = 0
        self._last_ns = 0
        self._had_plan = False
        self._observer_ns: int | None = None
        self._clock_ns: int | None = None
        self._observer_stopped = ""
        self._stop_damping = stop_damping(settings.supervision)

    def start(self, q: Array, v: Array, now_ns: int) -> None:
        """Begin to hold the arm at the state at hand; the first command is the torque that holds it.

        A stop stays in force.

        Raises
        ------
        InputError
            If the state is not finite or lies outside the joint limits.
        """
        _check_start(q, v)
        self.model.update(q, v)
        self.limiter.start(self._hold_torque())
        self._last_ns = now_ns
        self._restart(q, now_ns)
        self._started = True

    def tick(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> Array:
        """The torque to send for one joint state, (7,), N m.

        Parameters
        ----------
        q, v
            Joint positions (7,) rad and velocities (7,) rad/s.
        now_ns
            Stamp of the joint state.
        clock_ns
            Time of the watchdogs' clock.

        Raises
        ------
        InputError
            If the state is not finite, or so far from any real one that the torque is not; nothing may be sent for it.
            Also before `start`.
        """
        if not self._started:
            raise InputError("the controller was not started: call start with the first joint state")
        _check_state(q, v)
        self.model.update(q, v)
        self._watch_observer(clock_ns)
        if now_ns < self._last_ns:
            # The clock was set back: what has been going on for a while still has.
            self._started_ns -= self._last_ns - now_ns
            self._hold_since_ns -= self._last_ns - now_ns
        supervision = self.settings.supervision
        if self.mode is Mode.STOPPED:
            torque = self.model.bias - self.model.gravity - self._stop_damping * v
        else:
            reference = self._reference(q, now_ns)
            self.error = pose_error(self.model.position, self.model.rotation, reference)
            torque = self.law.torque(self.model, v, q - reference.posture, self.error)
            torque += self.model.bias - self.model.gravity
            repulsion = self.repulsion.torque(q, v)
            if repulsion is not None:
                torque += repulsion
            since_start = (now_ns - self._started_ns) / NANOSECONDS
            if since_start < supervision.start_ramp:
                torque *= since_start / supervision.start_ramp
        torque += self._hold_torque()
        if not math.isfinite(sum(torque.tolist())):
            raise InputError(f"joint_states: no finite torque for velocity = {v.tolist()}; expected a possible state")
        # A late tick may not make up for the change that the ticks before it missed.
        period = min(max((now_ns - self._last_ns) / NANOSECONDS, 0.0), 0.001) or 0.001
        self._last_ns = now_ns
        return self.limiter.limit(torque, period)

    def observer_report(self, stopped_because: str, clock_ns: int) -> None:
        """Take the observer's sign of life; a non-empty reason stops the arm."""
        self._observer_ns = clock_ns
        self._observer_stopped = stopped_because
        if stopped_because:
            self.stop(stopped_because)

    def stop(self, reason: str) -> None:
        """Latch the compliant stop; the first reason is kept."""
        if self.mode is not Mode.STOPPED:
            self.mode = Mode.STOPPED
            self.stop_reason = reason

    def reset(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> None:
        """Release a stop and hold the arm where it is; earlier plans are forgotten.

        Raises
        ------
        InputError
            If the arm still moves or lies outside the joint limits, or the observer is silent or itself stopped; the
            stop stays.
        """
        _check_start(q, v)
        speed = float(np.abs(v).max())
        limit = self.settings.supervision.reset_velocity
        if not speed <= limit:
            raise InputError(f"the arm moves with {speed:.3f} rad/s; reset needs at most {limit:g} rad/s: wait for it")
        if self._observer_stopped:
            raise InputError(f"the observer is stopped ({self._observer_stopped}): reset the observer first")
        if self._observer_silence(clock_ns) is not None:
            raise InputError("the observer is silent: start it, then reset")
        self.references.clear(now_ns)
        self.mode = Mode.HOLDING
        self.stop_reason = ""
        self.model.update(q, v)
        # Not `start`: the limiter goes on from the last torque, so that the release brings no step.
        self._restart(q, now_ns)

    def _restart(self, q: Array, now_ns: int) -> None:
        """Hold the pose at hand, with authority ramping in; a stop stays in force."""
        if self.mode is not Mode.STOPPED:
            self.mode = Mode.HOLDING
        self._started_ns = now_ns
        self._begin_hold(q, now_ns)
        self._blend_from = self._hold
        self._had_plan = False

    def _hold_torque(self) -> Array:
        if self.settings.supervision.gravity_compensation:
            return self.model.gravity
        return np.zeros(iiwa14.N_JOINTS)

    def _reference(self, q: Array, now_ns: int) -> Reference:
        reference = self.references.select(now_ns)
        if reference is not None:
            self.mode = Mode.TRACKING
            self._had_plan = True
            self._last_reference = reference
            return reference
        if self.mode is Mode.TRACKING:
            self.mode = Mode.HOLDING
            self._blend_from = self._last_reference
            self._begin_hold(q, now_ns)
        return self._held(now_ns)

    def _begin_hold(self, q: Array, now_ns: int) -> None:
        self._hold = Reference(self.model.position.copy(), self.model.rotation.copy(), q.copy())
        self._hold_since_ns = now_ns

    def _held(self, now_ns: int) -> Reference:
        """The pose to hold; after a plan the reference decays to it, and after a further limit the arm stops."""
        supervision = self.settings.supervision
        held_for = (now_ns - self._hold_since_ns) / NANOSECONDS
        if self._had_plan and held_for > supervision.hold_limit:
            self.stop(f"no valid plan for {supervision.hold_limit:g} s")
        if held_for < supervision.hold_blend:
            return blend(self._blend_from, self._hold, held_for / supervision.hold_blend)
        return self._hold

    def _observer_silence(self, clock_ns: int) -> float | None:
        """Seconds of silence when they exceed the limit, else None; an observer never heard of is not waited for."""
        if self._observer_ns is None:
            return None
        silence = (clock_ns - self._observer_ns) / NANOSECONDS
        return silence if silence > self.settings.supervision.observer_timeout else None

    def _watch_observer(self, clock_ns: int) -> None:
        pause_ns = 0 if self._clock_ns is None else clock_ns - self._clock_ns
        self._clock_ns = clock_ns
        if self._observer_ns is not None and pause_ns > _PAUSE_NS:
            # This process was held up itself, and what the observer said meanwhile is still to be read.
            self._observer_ns += pause_ns
        silence = self._observer_silence(clock_ns)
        if silence is not None:
            self.stop(f"observer silent for {1000 * silence:.0f} ms")


def stop_damping(settings: SupervisionSettings) -> Array:
    """Damping (7,) of each joint in the compliant stop, N m s/rad."""
    limits = np.array(iiwa14.TORQUE_LIMITS)
    # The wrist's inertia is small: with the damping of A1 it would swing up if a command came one tick late.
    return settings.stop_damping * limits / limits.max()


def _check_start(q: Array, v: Array) -> None:
    """Raise `InputError` unless the arm can be held in this state."""
    _check_state(q, v)
    beyond = np.abs(q) > np.array(iiwa14.POSITION_LIMITS)
    if beyond.any():
        names = [name for name, is_beyond in zip(iiwa14.JOINT_NAMES, beyond, strict=True) if is_beyond]
        raise InputError(f"joint_states: {', '.join(names)} beyond the position limit; move the arm back by hand")


def _check_state(q: Array, v: Array) -> None:
    """Raise `InputError` unless positions and velocities are seven finite numbers each."""
    for name, values in (("position", q), ("velocity", v)):
        if values.shape != (iiwa14.N_JOINTS,):
            raise InputError(f"joint_states: {name} has shape {values.shape}; expected ({iiwa14.N_JOINTS},)")
        # A sum is finite exactly when no summand is NaN or infinite (opposite infinities make NaN).
        if not math.isfinite(sum(values.tolist())):
            raise InputError(f"joint_states: {name} = {values.tolist()}; expected finite values")
