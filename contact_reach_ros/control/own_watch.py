"""The controller's own watch: an observer that sees every state that the controller answers, whoever else is late."""

from __future__ import annotations

from contextlib import suppress
from typing import Protocol

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.supervisor import Supervisor
from contact_reach_ros.errors import InputError
from contact_reach_ros.stop_reasons import Verdict


class Report(Protocol):
    """What the controller needs of an observer's report."""

    @property
    def verdict(self) -> Verdict:
        """What the observer lets the controller do."""

    @property
    def due(self) -> bool:
        """Whether it has to be heard."""


class Watcher(Protocol):
    """What the controller needs of an observer; `observer.Observer` is one."""

    def update(self, state: JointState) -> Report | None:
        """Take a state; None for one that is not new. Raises `InputError` for one that is not finite."""

    def command(self, torque: Array) -> None:
        """Take a command (n,), N m."""

    def report(self) -> Report:
        """The conclusions so far."""

    def reset(self) -> None:
        """Release what is latched; raises `InputError` if the arm moves or is pushed."""


class OwnWatch:
    """Shows each state and command to an observer of the controller's own, and its verdicts to the supervisor."""

    def __init__(self, watcher: Watcher, supervisor: Supervisor) -> None:
        self._watcher = watcher
        self._supervisor = supervisor
        self.command = watcher.command
        supervisor.hear_own(Verdict(doubt="the controller's own watch has seen nothing yet"), 0)

    def see(self, state: JointState, started: bool, clock_ns: int) -> None:
        """Take a state, old ones included; `started`: whether the arm is commanded."""
        report = self._watcher.update(state)
        if report is None or not report.due:
            return
        self._supervisor.hear_own(report.verdict, clock_ns)
        if report.verdict.reason and not started:
            # Before the start there is nothing to stop: what has to be reset by hand is latched by the observer alone.
            with suppress(InputError):
                self._watcher.reset()

    def reset(self, clock_ns: int) -> None:
        """Release what the watch has latched.

        Raises
        ------
        InputError
            If the arm moves or is still pushed, or the watch sees nothing.
        """
        if not self._supervisor.own_reason:
            return
        self._watcher.reset()
        self._supervisor.hear_own(self._watcher.report().verdict, clock_ns)
        if self._supervisor.own_reason:
            raise InputError(f"the controller's own watch is stopped ({self._supervisor.own_reason})")
