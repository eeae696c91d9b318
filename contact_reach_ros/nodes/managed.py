"""What all nodes of the stack have in common: lifecycle, parameters, diagnostics, and a clean start and end."""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from contact_reach_ros import __version__
from contact_reach_ros.cpus import isolated_cpus
from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.nodes.discovery import choose_discovery
from contact_reach_ros.nodes.parameters import Sections, check_arguments, declare
from contact_reach_ros.nodes.realtime import (
    Inbox,
    Role,
    choose_cpus,
    come_first,
    give_way,
    prioritise_background,
    prioritise_middleware,
    request_realtime,
    return_large_blocks,
    share_heap,
    use_cpus,
)
from contact_reach_ros.nodes.topics import DIAGNOSTICS, SETTINGS, Topic
from contact_reach_ros.parameter_files import full_name
from contact_reach_ros.recording.intake import IntakeLog, Taken
from contact_reach_ros.settings import Settings

_IDLE_NS = 100_000_000


class ManagedNode(LifecycleNode):
    """A lifecycle node whose work is done by one loop thread.

    Subclasses set `NAME` and `SECTIONS`, create their subscriptions in `self.inbox`, and implement `turn`.

    Attributes
    ----------
    settings
        The settings objects by parameter prefix.
    running
        Whether the node is active.
    lockstep
        Whether time is simulated and waits for every node: each is busy then, and none is late.
    """

    NAME: ClassVar[str]
    SECTIONS: ClassVar[Sections]

    def __init__(self) -> None:
        super().__init__(self.NAME)
        autostart = self.declare_parameter("autostart", True)
        self.autostart = bool(autostart.value)
        self.cpus = str(self.declare_parameter("cpus", "auto").value)
        self.lockstep = bool(self.get_parameter("use_sim_time").value)
        self.settings = declare(self, self.SECTIONS)
        self.inbox = Inbox(self)
        self.running = False
        self.refused: dict[str, int] = {}
        self._diagnostics = self.create_publisher(DIAGNOSTICS.type, DIAGNOSTICS.name, DIAGNOSTICS.qos)
        self._told_settings = self.make_publisher(SETTINGS)
        self._stop = threading.Event()
        self._refusals: dict[str, str] = {}
        self._lines: deque[tuple[LoggingSeverity, str]] = deque()
        self._said = self.create_guard_condition(self.write_out)
        self.create_timer(1.0, self._publish_diagnostics, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def turn(self) -> None:
        """One turn of the loop while the node is active; waits for what it needs, at most 0.1 s."""
        self.inbox.wait(_IDLE_NS)

    def close(self) -> None:
        """Bring to an end what `on_deactivate` would, when the process ends while the node is active."""

    def files(self) -> Mapping[str, Settings]:
        """Settings that come from files of their own, by prefix, to be told with those that are parameters."""
        return {}

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """A summary (empty when all is well) and values for the diagnostics topic."""
        return "", {}

    def loop(self) -> None:
        """Take turns until `request_stop`; while the node is inactive its messages are dropped."""
        while not self._stop.is_set():
            if self.running:
                self.turn()
            else:
                self.inbox.run_tasks()
                self._stop.wait(0.02)

    def request_stop(self) -> None:
        """End the loop."""
        self._stop.set()
        self.inbox.wake()

    def make_publisher(self, topic: Topic) -> Any:
        """Publisher for a topic of the stack."""
        return self.create_publisher(topic.type, topic.name, topic.qos)

    def make_writer(self, topic: Topic) -> Callable[[bytes], None]:
        """What publishes serialised messages of a topic, for the loop of an active node.

        It goes past the checks of lifecycle publisher, context and type, which take as long as the loop's arithmetic.
        """
        write: Callable[[bytes], None] = self.make_publisher(topic).handle.publish_raw
        return write

    def log_intake(self, topic: Topic) -> IntakeLog:
        """Note from now on what the inbox handles, for a bag."""
        self.inbox.intake = IntakeLog(self.make_publisher(topic).publish)
        return self.inbox.intake

    def refuse(self, what: str, error: Exception) -> None:
        """Count refused input; the last refusal of each kind goes to the log, at most once a second."""
        self.refused[what] = self.refused.get(what, 0) + 1
        self._refusals[what] = str(error)

    def say(self, severity: LoggingSeverity, line: str) -> None:
        """Log a line from the loop thread, which must not wait for it: another thread writes it a little later."""
        self._lines.append((severity, line))
        self._said.trigger()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the loop's work."""
        result = super().on_activate(state)
        self._tell_settings()
        # The loop does not look at its inbox yet.
        self.inbox.note(Taken.ACTIVATE)
        self.running = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the loop idle."""
        self.running = False
        return super().on_deactivate(state)

    def write_out(self) -> None:
        """Log what the loop thread has said."""
        while self._lines:
            severity, line = self._lines.popleft()
            self._log(severity, line)

    def _log(self, severity: LoggingSeverity, line: str) -> None:
        logger = self.get_logger()
        # rclpy holds that one place in the code logs at one severity only.
        if severity is LoggingSeverity.INFO:
            logger.info(line)
        elif severity is LoggingSeverity.WARN:
            logger.warning(line)
        else:
            logger.error(line)

    def _tell_settings(self) -> None:
        """For bags: what the node runs with, each value as JSON."""
        settings = {**self.settings, **self.files()}
        values = {
            full_name(prefix, entry.name): getattr(values, entry.name)
            for prefix, values in settings.items()
            for entry in values.declared()
        }
        values["use_sim_time"] = self.get_parameter("use_sim_time").value
        self._told_settings.publish(
            DiagnosticStatus(
                name=self.NAME,
                message=f"contact_reach_ros {__version__}",
                values=[KeyValue(key=key, value=json.dumps(value)) for key, value in values.items()],
            )
        )

    def _publish_diagnostics(self) -> None:
        while self._refusals:
            _, refusal = self._refusals.popitem()
            self._log(LoggingSeverity.WARN, refusal)
        summary, values = self.diagnosis()
        refused = {f"refused {what}": count for what, count in self.refused.items()}
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if summary else DiagnosticStatus.OK,
            name=self.get_name(),
            message=summary or "ok",
            values=[KeyValue(key=key, value=_text(value)) for key, value in {**values, **refused}.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def run(node_class: type[ManagedNode], role: Role, arguments: Sequence[str], priority: int = 0) -> int:
    """Run one node until SIGINT, SIGTERM or a failure of its loop; returns the exit code of the process.

    Parameters
    ----------
    node_class
        What to run; the arguments are checked against its settings.
    role
        What the process is for.
    arguments
        Command line, program name first.
    priority
        SCHED_FIFO priority of a loop or monitor.
    """
    try:
        check_arguments(arguments, node_class.NAME, node_class.SECTIONS)
    except ContactReachError as error:
        print(f"{node_class.NAME}: {error}", file=sys.stderr)
        return 2
    sys.setswitchinterval(2e-4)
    if role in (Role.COMPUTING, Role.BACKGROUND):
        # Not where the loop would wait for another thread's allocation.
        share_heap()
    if role is Role.BACKGROUND:
        return_large_blocks()
    node: ManagedNode | None = None
    try:
        initialise(arguments)
        node = node_class()
        return _serve(node, role, priority)
    except ContactReachError as error:
        print(f"{node_class.NAME}: {error}", file=sys.stderr)
        return 2
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def initialise(arguments: Sequence[str], discovery: str = "host") -> None:
    """Start rclpy; signals are left to the caller.

    Parameters
    ----------
    arguments
        Command line, program name first.
    discovery
        How far its nodes can be heard, one of `discovery.CHOICES`, unless the environment says otherwise.

    Raises
    ------
    SettingsError
        If ROS does not understand the arguments.
    """
    choose_discovery(discovery)
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except rclpy_implementation.RCLError as error:
        raise SettingsError(f"ROS refused the arguments {' '.join(arguments[1:])}: {error}") from error


def run_measurement(name: str, measure: Callable[[Node], Any]) -> None:
    """Have a bare node measure something and print it as JSON, unless it only helped; exit code 2 where it cannot."""
    try:
        initialise([name])
        node = Node(name)
        result = measure(node)
        if result is not None:
            print(json.dumps(result), flush=True)
        node.destroy_node()
    except ContactReachError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(2)
    finally:
        rclpy.try_shutdown()


def _serve(node: ManagedNode, role: Role, priority: int) -> int:
    """Loop and executor in a thread each; the main thread sleeps until a signal, which wakes no other.

    An executor that had to look for signals would be awake more often than all it serves needs.
    """
    failures: list[BaseException] = []
    # Not an Event, which a signal handler may not set while the same thread waits for it.
    ended: queue.SimpleQueue[None] = queue.SimpleQueue()
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def work(task: Callable[[], None]) -> None:
        try:
            task()
        except BaseException as error:  # handed to the main thread, which ends the process with it
            failures.append(error)
        ended.put(None)

    cpus = choose_cpus(node.cpus, role, os.sched_getaffinity(0), isolated_cpus())
    # Until the node is up a signal ends it at once: compiling, for one, takes long and cannot be interrupted.
    _on_signals(signal.SIG_DFL)
    if node.autostart and not _start(node):
        return 1
    # Also the first use of the logger, which takes long.
    node.get_logger().info("active" if node.running else "waiting to be configured")
    use_cpus(cpus)
    # Loops that never sleep would keep everything of lower priority from running, first of all their own services.
    warning = "" if node.lockstep else _prioritise(role, priority)
    if warning:
        node.get_logger().warning(warning)
    _on_signals(lambda *_: ended.put(None))

    def serve() -> None:
        give_way()
        executor.spin()

    tasks = {"loop": node.loop, "services": serve}
    threads = [threading.Thread(target=work, args=[task], name=name) for name, task in tasks.items()]
    for thread in threads:
        thread.start()
    try:
        ended.get()
    finally:
        node.request_stop()
        executor.shutdown()
        for thread in threads:
            thread.join()
        if node.inbox.intake is not None:
            node.inbox.intake.flush()
        node.close()
        node.write_out()
    if failures:
        node.get_logger().fatal(f"the node ended with {type(failures[0]).__name__}: {failures[0]}")
        return 1
    return 0


def _prioritise(role: Role, priority: int) -> str:
    """Priorities of a process that keeps real time; a warning for the log where they are not permitted."""
    if role in (Role.LOOP, Role.MONITOR):
        return request_realtime(priority)
    if role is Role.COMPUTING:
        come_first()
        return prioritise_middleware()
    return prioritise_background() if role is Role.BACKGROUND else ""


def _on_signals(handler: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def _start(node: ManagedNode) -> bool:
    """Configure and activate; says what failed."""
    for transition in (node.trigger_configure, node.trigger_activate):
        if transition() != TransitionCallbackReturn.SUCCESS:
            node.get_logger().fatal(f"{transition.__name__.removeprefix('trigger_')} failed; see the message above")
            return False
    return True
