"""Starts, awaits and watches the processes of the stack, and ends them so that the arm comes to rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from lifecycle_msgs.srv import GetState
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from contact_reach_ros.bringup.children import Children, Interruption, StackError
from contact_reach_ros.bringup.processes import Process, Wave
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.client import CONTROLLER, Client
from contact_reach_ros.ros.graph import running
from contact_reach_ros.ros.interfaces import RECORDER
from contact_reach_ros.ros.scheduling import prioritise_middleware
from contact_reach_ros.settings import as_arguments, namespace_arguments

_ACTIVE = "active"
_STARTUP_S = 240.0
"""The first start compiles the planner."""
_POLL_S = 0.1
_REST_SPEED = 0.02
_REST_TIMEOUT_S = 2.0
_ANSWERS = (topics.COMMANDS, topics.EXTERNAL_TORQUE)
"""Topics that a recorder should hear before time begins: of earlier messages it receives only the last seconds."""
_HEARD_S = 3.0
"""Longest wait for that: a recorder need not record everything."""
_DISCOVERY_S = 15.0
"""For nodes that are up to hear each other."""
_WATCHDOG_S = 0.3
"""Time in which the driver's watchdog brings the arm to rest when nobody commands it."""


class StackProcesses:
    """The processes of the running stack.

    Parameters
    ----------
    client
        For services and topics.
    table
        From `processes`.
    parameter_file
        Given to every process.
    interruption
        Checked by `check`, and so during every wait.
    log
        File for the output of the processes; their own terminal when None.
    passed_on
        ROS arguments for every process, such as remappings. All have the node's namespace.
    """

    def __init__(
        self,
        client: Client,
        table: Sequence[Process],
        parameter_file: Path,
        interruption: Interruption,
        log: Path | None = None,
        passed_on: Sequence[str] = (),
    ) -> None:
        self.client = client
        self._passed_on = passed_on
        self._interruption = interruption
        self._table = list(table)
        self.parameter_file = parameter_file
        self._children = Children(log)
        self._speed = float("nan")
        client.inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST)

    def bring_up(self, progress: Callable[[str], None]) -> None:
        """Start all processes and wait until each is up and each lifecycle node active.

        Parameters
        ----------
        progress
            Called repeatedly with a line that names what is awaited.

        Raises
        ------
        StackError
            If a process died, or it takes too long; the missing ones are named with their last state.
        KeyboardInterrupt
            If it was interrupted.
        """
        prioritise_middleware()
        deadline = time.monotonic() + _STARTUP_S
        for wave in Wave:
            if wave is Wave.LOOPS:
                self._look_around()
            processes = [process for process in self._table if process.wave is wave]
            if wave is Wave.LAST and processes and RECORDER in self._children:
                self._not_recorded(_ANSWERS, _HEARD_S)
            for process in processes:
                self._children.start(process.name, ["-m", process.module, *self._arguments(process)])
            self._wait_active(processes, deadline, progress)
            self._children.optional |= {process.name for process in processes if not process.essential}

    def wait_recorded(self, heard: Sequence[Topic]) -> None:
        """Wait until the recorder has subscribed to topics, each of which it first has to discover.

        Raises
        ------
        StackError
            If a process died, or it takes too long; the topics that are not heard are named.
        KeyboardInterrupt
            If it was interrupted.
        """
        missing = self._not_recorded(heard, _DISCOVERY_S)
        if missing:
            names = ", ".join(topic.name for topic in missing)
            raise StackError(f"{RECORDER} does not hear {names} after {_DISCOVERY_S:.0f} s{self._children.see_log()}")

    def _look_around(self) -> None:
        """Look for another stack once more: discovery has settled while the first processes got ready."""
        others = running(self.client.node, [process.name for process in self._table], self._children.process_ids)
        if others:
            raise StackError(f"another stack is running in this ROS domain: {', '.join(others)}")

    def _not_recorded(self, heard: Sequence[Topic], timeout: float) -> list[Topic]:
        """Wait until the recorder hears topics, for at most some s; returns those that it still does not hear."""
        deadline, missing = time.monotonic() + timeout, list(heard)
        while missing and time.monotonic() < deadline:
            self.watch(_POLL_S)
            missing = [topic for topic in missing if not self._is_recorded(topic)]
        return missing

    def _is_recorded(self, topic: Topic) -> bool:
        node = self.client.node
        hearing = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic.name))
        return any(endpoint.node_name == RECORDER for endpoint in hearing)

    def _wait_active(self, processes: Sequence[Process], deadline: float, progress: Callable[[str], None]) -> None:
        missing = {process.name: "not asked yet" for process in processes}
        while missing:
            if time.monotonic() > deadline:
                named = ", ".join(f"{name} ({state})" for name, state in missing.items())
                raise StackError(f"not active after {_STARTUP_S:.0f} s: {named}{self._children.see_log()}")
            progress("waiting for " + ", ".join(missing))
            missing |= {name: self._state_of(name) for name in missing}
            missing = {name: state for name, state in missing.items() if state != _ACTIVE}
            self.watch(_POLL_S)

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
            If there was an interruption.
        """
        self._interruption.check()
        self._children.check()

    @property
    def process_ids(self) -> dict[str, int]:
        """Of the processes that were started, by name."""
        return self._children.process_ids

    def shutdown(self) -> None:
        """Bring the arm to rest and end all processes: planner first, recorder and viewer last."""
        self._halt()
        for process in reversed(self._table):
            self._children.end(process.name)
            if process.name == CONTROLLER:
                self.client.spin(_WATCHDOG_S)
        self.client.close()
        self._children.close()

    def _arguments(self, process: Process) -> list[str]:
        file = self.parameter_file
        return [
            *("--ros-args", "--enclave", process.enclave, "--params-file", str(file)),
            *namespace_arguments(self.client.node.get_namespace(), file, process.name),
            *self._passed_on,
            *as_arguments(process.parameters),
        ]

    def _state_of(self, name: str) -> str:
        """Lifecycle state of a node, or why it is unknown."""
        try:
            answer = self.client.call(f"{name}/get_state", GetState, GetState.Request(), patience=0.0, timeout=1.0)
        except ContactReachError as error:
            return str(error)
        return str(answer.current_state.label)

    def _halt(self) -> None:
        """Ask the controller for its compliant stop and wait until the arm is at rest."""
        if not self._children.is_alive(CONTROLLER):
            self.client.spin(_WATCHDOG_S)
            return
        with suppress(ContactReachError):
            self.client.call(f"{CONTROLLER}/stop", Trigger, Trigger.Request(), patience=0.5, timeout=0.5)
        self.client.until(lambda: not self._speed > _REST_SPEED, _REST_TIMEOUT_S)

    def _on_state(self, message: JointState) -> None:
        self._speed = float(np.abs(message.velocity).max()) if message.velocity else float("nan")
