"""The controller: laws, limits and supervision, one tick per joint state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from contact_reach_ros.arm import Arm, Array, JointState, check_fresh
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import body_of, make_constants
from contact_reach_ros.control.follower import Follower
from contact_reach_ros.control.kernels import Constant, tracking_torque
from contact_reach_ros.control.passive_stop import PassiveStop
from contact_reach_ros.control.references import References
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.control.stability import check_gains
from contact_reach_ros.control.supervisor import OBSERVER, OWN_WATCH, Event, Mode, Supervisor, check_start, check_state
from contact_reach_ros.errors import InputError, Verdict
from contact_reach_ros.timing import GAP_PERIODS, NANOSECONDS, StampOrder

if TYPE_CHECKING:
    from contact_reach_ros.observer.observer import Observer

START_RAMP = 0.5
"""Time in which the laws reach full authority, s: a wrong model or plan shows as a slow motion first."""
HELD_AFTER = 0.02
"""Time without a command after which a drive holds the arm by itself, s."""
MOVED = 0.005
"""How far a joint may have moved meanwhile, rad, so that what is held stays: without tension, an arm that is heavier
than its model would sink a little in every pause."""


class Controller:
    """Turns joint states and references into torques: starts up, orders the states, and computes one tick for each.

    Stamps are integer nanoseconds of the clock that stamps joint states and plans; `clock_ns` is the clock of the
    watchdogs, which must never jump (the steady clock on a robot).

    Attributes
    ----------
    follower
        What the law follows, and the plans in force or waiting.
    supervisor
        The state machine, and everything that stops the arm.
    state
        The last joint state that was answered; None before the first.
    stamp_ns
        Stamp of the last joint state received, including refused ones.
    order
        Counts repeated and late states.
    started
        Whether the controller has started since its last activation.
    not_yet
        Why the arm may not start yet; empty when it may.
    not_vouched
        Why the observer does not let the arm start; empty when it does.
    in_force
        Whether commands act on the arm, as an adapter reports. While they do not, the arm is held wherever it is, and
        no plan is followed.
    """

    def __init__(
        self,
        arm: Arm,
        settings: ControllerSettings,
        period: float = 0.001,
        hold: Sequence[float] | None = None,
    ) -> None:
        """Raise `SettingsError` if the arm cannot hold the task, or the gains are not stable at this rate.

        Parameters
        ----------
        arm, settings
            The arm, and all settings.
        period
            Nominal time between joint states, s.
        hold
            Torque (n,) up to which a joint is held in any case, N m: the budget's hand-over limits; the arm's by
            default.
        """
        settings = settings.resolve(arm)
        check_gains(arm, settings.impedance, period, settings.limits.torque_delay)
        self.arm = arm
        self.settings = settings
        self.model = RobotModel(arm)
        self.follower = Follower(arm.n, settings.impedance, settings.supervision, period)
        self.supervisor = Supervisor(arm, settings.supervision, period)
        self.order = StampOrder()
        self.state: JointState | None = None
        self.stamp_ns = 0
        self.not_yet = self.not_vouched = ""
        self.in_force = not settings.supervision.adapter
        self._found = np.zeros(7)
        self._watcher: Observer | None = None
        self._watched_ns = 0
        """When a state was last shown to it, on the watchdogs' clock."""
        self._period = period
        self._constants = make_constants(arm, settings.impedance, settings.limits, settings.supervision, period, hold)
        self._body = body_of(self.model)
        self._stop = PassiveStop(arm, self._constants)
        self._sent = np.zeros(arm.n)
        """The last torque, which limits the change of the next one."""
        self.started = False
        self._started_ns = 0
        self._last_ns = 0
        self._last_clock_ns: int | None = None
        self._held_ns = round(max(HELD_AFTER, GAP_PERIODS * period) * NANOSECONDS)

    def watch_with(self, watcher: Observer) -> None:
        """Take an observer for `watch`, which nobody else may use, if the settings want the controller to have one.

        From then on the controller does not start unless it confirms the states, too.
        """
        if self.settings.supervision.has_own_watch:
            self._watcher = watcher
            self.supervisor.hear(OWN_WATCH, Verdict(doubt="the controller's own watch has seen nothing yet"), 0)

    @property
    def error(self) -> Array:
        """Δx of the last tick, (6,), m and rad."""
        return self._found[:6]

    @property
    def speed_share(self) -> float:
        """Greatest speed of a point of the arm at the last tick, as a share of the permitted one there."""
        return float(self._found[6])

    @property
    def mode(self) -> Mode:
        """State of the state machine."""
        return self.supervisor.mode

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped; empty while it is not."""
        return self.supervisor.stop_reason

    def activate(self) -> None:
        """Start again from the next joint state; a stop stays in force."""
        self.started = False

    def update(self, state: JointState, clock_ns: int) -> Array | None:
        """Answer one joint state, which becomes `state` if it is new.

        The first state that the observer confirms starts the controller: the first command is the torque that
        holds the arm.

        Returns
        -------
        Array | None
            The torque to send, (n,), N m; None when nothing may be sent, and for a state that is not new.

        Raises
        ------
        InputError
            If the state is not finite, or so far from any real one that the torque is not; or if the arm may not start,
            for `not_yet` or because it is outside its limits. Nothing may be sent then.
        """
        stamp_ns, q, v, _ = state
        if self.started and not self.order.is_new(stamp_ns):
            return None
        self.stamp_ns = stamp_ns
        if not self.started:
            self.not_vouched = self.supervisor.not_vouched(clock_ns)
            if self.not_vouched:
                check_start(self.arm, q, v)
                self.state = state
                return None
            if self.not_yet:
                raise InputError(f"{self.not_yet}; nothing is commanded")
            self.start(q, v, stamp_ns)
            self.order.is_new(stamp_ns)
        torque = self._tick(q, v, stamp_ns, clock_ns)
        self.state = state
        return torque

    def watch(self, state: JointState, clock_ns: int) -> None:
        """Show a state to the controller's own watch, whether new or not; without one nothing happens.

        It may take longer than `update`: call it when the torque for the state has been sent. The next tick acts on
        what it finds.

        Raises
        ------
        InputError
            If the state is not finite.
        """
        report = None if self._watcher is None else self._watcher.update(state)
        if self._watcher is None or report is None:
            return
        self._watched_ns = clock_ns
        if not report.due:
            return
        self.supervisor.hear(OWN_WATCH, report.verdict, clock_ns)
        if report.verdict.reason and not self.started:
            # Before the start there is nothing to stop: what has to be reset by hand is latched by the observer alone.
            with suppress(InputError):
                self._watcher.reset(0.0)

    def follow(self, references: References) -> None:
        """Take the references of a plan; they take effect at their stamp.

        Raises
        ------
        InputError
            If they are malformed, no longer valid, too far ahead, or from before the last stop.
        """
        self.follower.queue.offer(references, self.stamp_ns)

    def withdraw(self) -> None:
        """Forget all plans: the next tick holds the arm where it is."""
        self.follower.queue.forget()

    def hear(self, verdict: Verdict, clock_ns: int) -> None:
        """Take a report of the observer, which is also its heartbeat; the arm does not start before one without doubt.

        `clock_ns`: time of its arrival on the watchdogs' clock.
        """
        self.supervisor.hear(OBSERVER, verdict, clock_ns)

    def start(self, q: Array, v: Array, now_ns: int) -> None:
        """Begin to hold the arm in the given state; a stop stays in force.

        Raises
        ------
        InputError
            If the state is not finite or lies outside the joint limits.
        """
        check_start(self.arm, q, v)
        self.model.update(q, v)
        self.resume(self._hold_torque())
        self._last_ns = now_ns
        self._restart(q, now_ns)
        self.supervisor.happens(Event.START)
        self.started = True

    def _tick(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> Array | None:
        """The torque to send for one joint state of stamp `now_ns`, (n,), N m, as `update`."""
        check_state(self.arm, q, v)
        self.model.update(q, v)
        self.supervisor.watch_observer(clock_ns)
        self.supervisor.watch_joints(q, v)
        self.supervisor.watch_contact(v, clock_ns)
        self.supervisor.watch_stop(v, clock_ns)
        paused_ns, self._last_clock_ns = clock_ns - (self._last_clock_ns or clock_ns), clock_ns
        if self.mode is Mode.SILENT:
            self._last_ns = now_ns
            return None
        if (paused_ns > self._held_ns and self._has_moved(q)) or not self.in_force:
            # The drive, or somebody else, has moved the arm meanwhile: what is held is where it is now.
            self.resume(self._hold_torque())
            self._restart(q, now_ns)
            self._stop.begin()
        if now_ns < self._last_ns:
            # The clock was set back: the elapsed times must not shrink with it.
            self._started_ns -= self._last_ns - now_ns
            self.follower.set_back(self._last_ns - now_ns)
        # A late tick must not make up for the change that the ticks before it missed.
        period = min(max((now_ns - self._last_ns) / NANOSECONDS, 0.0), self._period) or self._period
        if self.supervisor.is_passive:
            torque = self._stop.torque(self.model, q, v, self._sent, period)
            self._restart(q, now_ns)
        else:
            self._stop.begin()
            torque = self._track(q, v, now_ns, period)
            self.supervisor.watch_speed(self.speed_share)
        if math.isnan(torque[0]):
            raise InputError(f"joint_states: no finite torque for velocity = {v.tolist()}; expected a possible state")
        self._last_ns = now_ns
        self._sent = torque
        return torque

    def resume(self, torque: Array) -> None:
        """Continue from a torque (n,), N m, as the last one sent, which limits the change of the next one."""
        cap = self._constants[Constant.TORQUE_CAP]
        self._sent = np.clip(torque, -cap, cap)

    def stop(self, reason: str) -> None:
        """Latch the compliant stop; the first reason is kept."""
        self.supervisor.stop(reason)

    def check_ready(self) -> None:
        """Raise `InputError` while no reset is possible: before the first joint state, and while `not_yet` is set."""
        if not self.started or self.state is None:
            raise InputError("the controller has not seen a joint state yet")
        if self.not_yet:
            raise InputError(f"{self.not_yet}; no reset before that")

    def reset(self, clock_ns: int) -> None:
        """Release a stop and hold the arm where it is; earlier plans are forgotten.

        Raises
        ------
        InputError
            If the arm still moves, is pushed or lies outside the joint limits, if its last state is too old to tell,
            or the observer is silent or itself stopped; the stop stays. Also where `check_ready` raises.
        """
        self.check_ready()
        assert self.state is not None
        q, v, now_ns = self.state.q, self.state.v, self.stamp_ns
        check_fresh((clock_ns - (self._last_clock_ns or 0)) / NANOSECONDS)
        self.supervisor.check_reset(q, v, clock_ns)
        if self._watcher is not None:
            self._watcher.reset((clock_ns - self._watched_ns) / NANOSECONDS)
            self.supervisor.hear(OWN_WATCH, self._watcher.report().verdict, clock_ns)
        was_silent = self.mode is Mode.SILENT
        self.supervisor.happens(Event.RESET)
        self.model.update(q, v)
        # Unless nothing was being sent, it continues from the last torque, so that the release brings no step.
        if was_silent:
            self.resume(self._hold_torque())
        self._restart(q, now_ns)

    def rehearse(self) -> None:
        """Run through every step once, with a controller that is not used for anything else.

        Work that libraries do at their first call must not happen while an arm waits.
        """
        q, v = np.array(self.arm.home), np.zeros(self.arm.n)
        self.hear(Verdict(), 1)
        self.update(JointState(1, q, v, None), 1)
        position, rotation = self.model.tip_pose(q)
        self.follow(References(1, (10,), position[None], rotation[None], q[None]))
        for now_ns in (2, 20):
            self.update(JointState(now_ns, q, v, None), now_ns)
        self.stop("rehearsal")
        self.update(JointState(21, q, v, None), 21)

    def _restart(self, q: Array, now_ns: int) -> None:
        """Forget all plans and hold the current pose, with authority ramping in; a stop stays in force."""
        self._started_ns = now_ns
        self.follower.restart(self.model, q, now_ns)

    def _has_moved(self, q: Array) -> bool:
        return self.state is None or not np.abs(q - self.state.q).max() <= MOVED

    def _hold_torque(self) -> Array:
        """Torque that holds the arm at rest, (n,), N m: zero where the arm compensates gravity itself."""
        return self._constants[Constant.GRAVITY_SHARE] * self.model.gravity

    def _track(self, q: Array, v: Array, now_ns: int, period: float) -> Array:
        """The torque (n,) towards the reference in force, N m; NaN if it is not finite."""
        model, supervisor, follower = self.model, self.supervisor, self.follower
        reference = follower.follow(model, q, self.error, now_ns, supervisor.torque_known)
        supervisor.happens(Event.PLAN if follower.follows else Event.PLAN_ENDED)
        supervisor.watch_hold(follower.held_for(now_ns), follower.had_plan)
        since_start = (now_ns - self._started_ns) / NANOSECONDS
        authority = min(since_start / START_RAMP, 1.0)
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
            *reference,
            *self._body,
            q,
            v,
            authority,
            self._sent,
            period,
            self._found,
        )
