"""The controller: laws, limits and supervision, one tick per joint state."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.kernels import Constant, stopping_torque, tracking_torque
from contact_reach_ros.control.law import Reference
from contact_reach_ros.control.reference import ReferenceQueue, blend
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import Event, Mode, Supervisor, check_start, check_state
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
        self.references = ReferenceQueue(settings.supervision.max_plan_lead)
        self.supervisor = Supervisor(settings.supervision)
        self.error = np.zeros(6)
        """Δx of the last tick, (6,), m and rad."""
        self._constants = make_constants(settings.impedance, settings.limits, settings.supervision)
        self._sent = np.zeros(iiwa14.N_JOINTS)
        """The last torque, which the next one may differ from by so much."""
        self._started = False
        self._hold = self._blend_from = self._last_reference = _NOWHERE
        self._hold_since_ns = 0
        self._started_ns = 0
        self._last_ns = 0
        self._had_plan = False

    def start(self, q: Array, v: Array, now_ns: int) -> None:
        """Begin to hold the arm at the state at hand; the first command is the torque that holds it.

        A stop stays in force.

        Raises
        ------
        InputError
            If the state is not finite or lies outside the joint limits.
        """
        check_start(q, v)
        self.model.update(q, v)
        self.continue_from(self._hold_torque())
        self._last_ns = now_ns
        self._restart(q, now_ns)
        self.supervisor.happens(Event.START)
        self._started = True

    def tick(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> Array | None:
        """The torque to send for one joint state, (7,), N m; None when nothing may be sent any more.

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
        check_state(q, v)
        self.model.update(q, v)
        self.supervisor.watch_observer(clock_ns)
        self.supervisor.watch_joints(q, v)
        self.supervisor.watch_stop(v, clock_ns)
        if self.mode is Mode.SILENT:
            self._last_ns = now_ns
            return None
        if now_ns < self._last_ns:
            # The clock was set back: what has been going on for a while still has.
            self._started_ns -= self._last_ns - now_ns
            self._hold_since_ns -= self._last_ns - now_ns
        # A late tick may not make up for the change that the ticks before it missed.
        period = min(max((now_ns - self._last_ns) / NANOSECONDS, 0.0), 0.001) or 0.001
        if self.mode is Mode.STOPPED:
            model = self.model
            torque = stopping_torque(self._constants, model.bias, model.gravity, v, self._sent, period)
        else:
            torque = self._track(q, v, now_ns, period)
        if math.isnan(torque[0]):
            raise InputError(f"joint_states: no finite torque for velocity = {v.tolist()}; expected a possible state")
        self._last_ns = now_ns
        self._sent = torque
        return torque

    def continue_from(self, torque: Array) -> None:
        """Take a torque (7,) in N m as the last one sent, from which the next one differs only so much."""
        cap = self._constants[Constant.TORQUE_CAP]
        self._sent = np.clip(torque, -cap, cap)

    @property
    def mode(self) -> Mode:
        """What the controller does."""
        return self.supervisor.mode

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped; empty while it is not."""
        return self.supervisor.stop_reason

    def observer_report(self, stopped_because: str, clock_ns: int, distrust: str = "") -> None:
        """Take the observer's sign of life, as `Supervisor.observer_report`."""
        self.supervisor.observer_report(stopped_because, clock_ns, distrust)

    def stop(self, reason: str) -> None:
        """Latch the compliant stop; the first reason is kept."""
        self.supervisor.stop(reason)

    def reset(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> None:
        """Release a stop and hold the arm where it is; earlier plans are forgotten.

        Raises
        ------
        InputError
            If the arm still moves or lies outside the joint limits, or the observer is silent or itself stopped; the
            stop stays.
        """
        self.supervisor.check_reset(q, v, clock_ns)
        self.references.clear(now_ns)
        was_silent = self.mode is Mode.SILENT
        self.supervisor.happens(Event.RESET)
        self.model.update(q, v)
        # Unless nothing was sent it goes on from the last torque, so that the release brings no step.
        if was_silent:
            self.continue_from(self._hold_torque())
        self._restart(q, now_ns)

    def _restart(self, q: Array, now_ns: int) -> None:
        """Hold the pose at hand, with authority ramping in; a stop stays in force."""
        self._started_ns = now_ns
        self._begin_hold(q, now_ns)
        self._blend_from = self._hold
        self._had_plan = False

    def _hold_torque(self) -> Array:
        """What holds the arm at rest, (7,), N m: nothing where the arm compensates gravity itself."""
        return self._constants[Constant.GRAVITY_SHARE] * self.model.gravity

    def _track(self, q: Array, v: Array, now_ns: int, period: float) -> Array:
        """The torque (7,) towards the reference in force, N m; NaN if it is not finite."""
        model = self.model
        reference = self._reference(q, now_ns)
        ramp = self.settings.supervision.start_ramp
        since_start = (now_ns - self._started_ns) / NANOSECONDS
        return tracking_torque(
            self._constants,
            model.mass_matrix,
            model.bias,
            model.gravity,
            model.position,
            model.rotation,
            model.jacobian,
            model.twist,
            model.drift,
            reference.position,
            reference.rotation,
            reference.posture,
            q,
            v,
            since_start / ramp if since_start < ramp else 1.0,
            self._sent,
            period,
            self.error,
        )

    def _reference(self, q: Array, now_ns: int) -> Reference:
        reference = self.references.select(now_ns)
        if reference is not None:
            if self.mode is not Mode.TRACKING:
                self.supervisor.happens(Event.PLAN)
            self._had_plan = True
            self._last_reference = reference
            return reference
        if self.supervisor.happens(Event.PLAN_ENDED):
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
        self.supervisor.watch_hold(held_for, self._had_plan)
        if held_for < supervision.hold_blend:
            return blend(self._blend_from, self._hold, held_for / supervision.hold_blend)
        return self._hold
