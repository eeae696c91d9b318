"""Starts, awaits and watches the processes of the stack, and ends them so that the arm comes to rest."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from sensor_msgs.msg import JointState

from contact_reach_ros.bringup.processes import BringupOptions, Process, processes
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.executables import end_with_parent
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.resources import PACKAGE
from contact_reach_ros.ros.client import Client, StackClient
from contact_reach_ros.ros.graph import refuse_beside_another
from contact_reach_ros.ros.interfaces import CONTROLLER, DRIVER, RECORDER
from contact_reach_ros.ros.process import in_namespace
from contact_reach_ros.ros.scheduling import prioritise_middleware
from contact_reach_ros.settings import AUTOSTART, as_arguments

_UP, _CONFIGURED, _ACTIVE = "up", "configured", "active"
"""A node that offers its lifecycle, and states of it."""
_BRAKED = "braked"
"""Safety state of the simulated driver while its brakes are closed."""
_STARTUP_S = 240.0
"""The first start compiles the planner."""
_READY_S = 60.0
"""For nodes that are up to hear each other, and for the brakes to open."""
_POLL_S = 0.1
_REST_SPEED = 0.02
_REST_TIMEOUT_S = 2.0
_END_TIMEOUT_S = 15.0
_WATCHDOG_S = 0.3
"""Time in which the driver's watchdog brings the arm to rest when nobody commands it."""


class StackError(ContactReachError):
    """The stack did not come up, or one of its processes died."""


class StackProcesses:
    """The processes of a stack, which end with the context that this manages; it is not entered beside another stack.

    From its creation on SIGINT, SIGTERM and SIGHUP are only noted, and `check` raises `KeyboardInterrupt`. Python would
    raise it anywhere, also where rclpy's C++ makes a Python object and then reports another error, and a second Ctrl-C
    would leave processes behind.

    Parameters
    ----------
    client
        For services and topics.
    options
        What to start.
    log
        File for the output of the processes, whose folder is made; their own terminal when None.
    passed_on
        ROS arguments for every process, such as remappings. All have the node's namespace.

    Attributes
    ----------
    stamp_ns
        Of the newest joint state, ns.

    Raises
    ------
    SceneError, SettingsError
        As `processes`.
    InputError
        Where it is entered beside another stack, or the log cannot be written.
    """

    def __init__(
        self,
        client: Client,
        options: BringupOptions,
        log: Path | None = None,
        passed_on: Sequence[str] = (),
    ) -> None:
        self.client = client
        self._passed_on = passed_on
        self._signal: int | None = None
        """The last signal that came."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # As with nohup.
            if signal.getsignal(number) is not signal.SIG_IGN or number != signal.SIGHUP:
                signal.signal(number, self._interrupt)
        self._table = processes(options, client.node.get_namespace())
        self._names = [process.name for process in self._table]
        self.parameter_file = options.parameter_file
        self._log_path = log
        self._log: BinaryIO | None = None
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._optional: set[str] = set()
        self.stamp_ns = 0
        self._speed = float("nan")
        client.inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST)

    def __enter__(self) -> StackProcesses:
        refuse_beside_another(self.client.node, self._names)
        if self._log_path is not None:
            try:
                self._log_path.parent.mkdir(parents=True, exist_ok=True)
                self._log = self._log_path.open("wb")
            except OSError as error:
                raise InputError(
                    f"'{self._log_path}' cannot be written: {error.strerror}; name a folder of yours"
                ) from error
        return self

    def __exit__(self, *_: object) -> None:
        """Bring the arm to rest and end all processes: planner first, what may hold the arm last."""
        self._halt()
        for process in reversed(self._table):
            self._wait_for(process.name) if process.lasts else self._end(process.name)
            if process.name == CONTROLLER:
                self.client.spin(_WATCHDOG_S)
        self.client.close()
        if self._log is not None:
            self._log.close()

    def bring_up(self, progress: Callable[[str], None]) -> None:
        """Start all processes and wait until each is up and each lifecycle node active.

        Parameters
        ----------
        progress
            Called with a line for what is awaited, each time that changes.

        Raises
        ------
        StackError
            If a process died, or it takes too long; the missing ones are named with their last state.
        InputError
            If another stack has been discovered meanwhile.
        KeyboardInterrupt
            If it was interrupted.
        """
        prioritise_middleware()
        wait_for = partial(self._await, time.monotonic() + _STARTUP_S, progress)
        first, loops = ([each for each in self._table if each.early is early] for early in (True, False))
        for process in first:
            self._start(process)
        wait_for(first, _UP, self._is_offered("get_state", GetState))
        for process in loops:
            self._start(process)
        wait_for(first, _ACTIVE, self._state_of)
        self._optional |= {process.name for process in first if not process.essential}
        wait_for(loops, _UP, self._is_offered("change_state", ChangeState))
        # Once more, before anything acts: discovery has settled while the processes came up.
        refuse_beside_another(self.client.node, self._names, self._running, patience=0.0)
        wait_for(loops, _CONFIGURED, self._taken_to(_CONFIGURED, Transition.TRANSITION_CONFIGURE, loops))
        wait_for(loops, _ACTIVE, self._taken_to(_ACTIVE, Transition.TRANSITION_ACTIVATE, loops))

    def _await(
        self,
        deadline: float,
        progress: Callable[[str], None],
        processes: Sequence[Process],
        wanted: str,
        state_of: Callable[[str], str],
    ) -> None:
        missing, shown = dict.fromkeys((process.name for process in processes), "not asked yet"), ""
        while missing:
            if time.monotonic() > deadline:
                named = ", ".join(f"{name} ({state})" for name, state in missing.items())
                raise StackError(f"not {wanted} after {_STARTUP_S:.0f} s: {named}{self._see_log()}")
            if (line := f"waiting for {', '.join(missing)} to be {wanted}") != shown:
                progress(line)
                shown = line
            missing |= {name: state_of(name) for name in missing}
            missing = {name: state for name, state in missing.items() if state != wanted}
            self.watch(_POLL_S)

    def _taken_to(self, wanted: str, transition: int, processes: Sequence[Process]) -> Callable[[str], str]:
        """Ask nodes for a transition of their lifecycle, all at once; returns the state of a node by its answer."""
        request = ChangeState.Request(transition=Transition(id=transition))
        answers = {each.name: self.client.ask(f"{each.name}/change_state", ChangeState, request) for each in processes}

        def state_of(name: str) -> str:
            if not answers[name].done():
                return "no answer yet"
            if not answers[name].result().success:
                raise StackError(f"{name} does not get {wanted}{self._see_log()}")
            return wanted

        return state_of

    def wait_to_start(self, client: StackClient) -> None:
        """Wait until goals move the simulated arm, and the recorder, if there is one, hears them.

        Raises `ContactReachError` if a process died, something stopped the arm, or it takes too long.
        """

        def missing() -> list[str]:
            self.check()
            if client.stops:
                raise StackError(f"stopped by {client.why_stopped}")
            brakes = ["open brakes of the driver"] if client.safety.get(DRIVER, _BRAKED) == _BRAKED else []
            recorded = (topics.GOAL_POSE, topics.JOINT_STATES) if RECORDER in self._names else ()
            unheard = [f"{topic.name} by the {RECORDER}" for topic in recorded if not client.hears(RECORDER, topic)]
            return [*client.missing(), *brakes, *unheard]

        client.wait_for(missing, _READY_S)

    def watch(self, seconds: float) -> None:
        """Serve the node for a while, then `check`."""
        self.client.spin(seconds)
        self.check()

    def check(self) -> None:
        """Check that all processes are alive; one that is not essential is only reported.

        Raises
        ------
        StackError
            Naming a process that died, and how.
        KeyboardInterrupt
            If a signal came, at every call.
        """
        if self._signal is not None:
            raise KeyboardInterrupt
        for name, process in list(self._running.items()):
            code = process.poll()
            if code is None:
                continue
            how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            if name not in self._optional:
                raise StackError(f"{name} ended ({how}){self._see_log()}")
            print(f"{name} ended ({how}); the stack goes on without it", file=sys.stderr)
            del self._running[name]

    def _interrupt(self, number: int, _: object) -> None:
        self._signal = number
        for stream in (1, 2) if number == signal.SIGHUP else ():
            # The terminal is gone: whatever is written there is an error from now on.
            if stat.S_ISCHR(os.fstat(stream).st_mode):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)

    def _start(self, process: Process) -> None:
        arguments = [
            *("--ros-args", "--enclave", process.enclave, "--params-file", str(self.parameter_file)),
            *in_namespace(self.client.node.get_namespace()),
            *self._passed_on,
            # The loops are activated when all else is ready.
            *as_arguments({**process.parameters, **({} if process.early else {AUTOSTART.name: False})}),
        ]
        self._running[process.name] = subprocess.Popen(
            [sys.executable, "-m", f"{PACKAGE}.nodes.{process.name}", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            # A Ctrl-C in the terminal reaches this process only, which then ends the others in order, or passes it on.
            start_new_session=True,
            preexec_fn=end_with_parent,
        )

    def _end(self, name: str) -> None:
        """End a process, if it is running: by SIGKILL if SIGTERM does not do it."""
        process = self._running.pop(name, None)
        if process is None or process.poll() is not None:
            return
        # Not SIGINT, which Python turns into a traceback while it is still importing.
        process.terminate()
        try:
            process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            print(f"{name} did not end within {_END_TIMEOUT_S:.0f} s of SIGTERM: killed", file=sys.stderr)
            process.kill()
            process.wait()

    def _wait_for(self, name: str) -> None:
        """Ask a process that holds the arm to end, and wait until it does; it gets the signals that come meanwhile."""
        process = self._running.pop(name, None)
        self._signal = signal.SIGTERM
        while process is not None and process.poll() is None:
            number, self._signal = self._signal, None
            if number is not None:
                process.send_signal(number)
            time.sleep(_POLL_S)

    def _see_log(self) -> str:
        """Where the output of the processes is, to be appended to a message."""
        return f"; its output is in {self._log_path}" if self._log_path else ""

    def _is_offered(self, service: str, kind: Any) -> Callable[[str], str]:
        """Returns the state of a node: up as soon as it offers a service of its lifecycle."""
        return lambda name: _UP if self.client.offers(f"{name}/{service}", kind) else "not up yet"

    def _state_of(self, name: str) -> str:
        """Lifecycle state of a node, or why it is unknown."""
        try:
            answer = self.client.call(f"{name}/get_state", GetState, GetState.Request(), patience=0.0, timeout=1.0)
        except ContactReachError as error:
            return str(error)
        return str(answer.current_state.label)

    def _halt(self) -> None:
        """Ask the controller for its compliant stop and wait until the arm is at rest."""
        controller = self._running.get(CONTROLLER)
        if controller is None or controller.poll() is not None:
            self.client.spin(_WATCHDOG_S)
            return
        self.client.trigger(CONTROLLER, "stop")
        self.client.until(lambda: not self._speed > _REST_SPEED, _REST_TIMEOUT_S)

    def _on_state(self, message: JointState) -> None:
        self.stamp_ns = nanoseconds(message.header.stamp)
        self._speed = float(np.abs(message.velocity).max()) if message.velocity else float("nan")
