"""A node as a process: how it starts and ends, with which threads, and with which priorities."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.executables import end_at_signals
from contact_reach_ros.ros.description import description_file, options_of
from contact_reach_ros.ros.discovery import environment
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import (
    check_arguments,
    given_parameters,
    namespace_in,
    without_parameters,
    without_ros_arguments,
)
from contact_reach_ros.ros.scheduling import choose_cpus, give_way, take_priority, use_cpus
from contact_reach_ros.settings import ROBOT, as_arguments

_LOOK_S = 0.1
"""Time after which the end of a process is noticed at the latest, s."""
_AGAIN_S = 1.0
"""A Ctrl-C this long after the first signal insists; sooner it may be the same one, passed on by launch."""


def run(node_class: type[ManagedNode], arguments: Sequence[str]) -> int:
    """Run one node until a signal that it heeds, or a failure of its loop; returns the exit code of the process.

    SIGINT, SIGTERM and SIGHUP ask it to end, see `ManagedNode.may_end`; a later SIGINT insists. In whatever namespace
    it is, it has the sections of its own name, and the clock of that namespace.

    Parameters
    ----------
    node_class
        What to run, with the role of its name; the arguments are checked against its settings.
    arguments
        Command line, program name first.
    """
    sys.setswitchinterval(2e-4)
    node: ManagedNode | None = None
    try:
        arguments = with_description(arguments, node_class.NAME)
        check_arguments(arguments, node_class.NAME, node_class.SECTIONS)
        namespace = namespace_in(arguments)
        # Behind the user's: of the remappings of a name the first one holds.
        initialise([*arguments, "--ros-args", "-r", "/clock:=clock"])
        ManagedNode.ARGUMENTS = arguments
        node = node_class()
        if node.get_namespace() != namespace:
            raise SettingsError(f"ROS put the node into {node.get_namespace()}; expected one -r __ns:=/NAMESPACE")
        return _serve(node)
    except ContactReachError as error:
        print(f"{node_class.NAME}: {error}", file=sys.stderr)
        return 2
    finally:
        ManagedNode.ARGUMENTS = ()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def initialise(arguments: Sequence[str]) -> None:
    """Start rclpy with a command line, program name first; signals are left to the caller.

    Nobody beyond this host hears its nodes unless the environment says so. Raises `SettingsError` if ROS does not
    understand the arguments, or cannot write its log.
    """
    os.environ.update(environment())
    without_ros_arguments(arguments)
    try:
        rclpy.init(args=without_parameters(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise SettingsError(
            f"ROS does not start: {error}; for its logs set ROS_LOG_DIR to a folder that you may write to"
        ) from error


def in_namespace(namespace: str) -> list[str]:
    """ROS arguments for a node in a namespace, such as left or /left; none if it is empty."""
    return ["--ros-args", "-r", f"__ns:=/{namespace.strip('/')}"] if namespace.strip("/") else []


@contextlib.contextmanager
def bare_node(name: str, arguments: Sequence[str] = ()) -> Iterator[Node]:
    """A node without a lifecycle, for a tool or a supervisor; ROS ends with it.

    The arguments are a command line, program name first. Raises `ContactReachError` if ROS does not start it.
    """
    initialise(arguments or [name])
    with contextlib.ExitStack() as end:
        end.callback(rclpy.try_shutdown)
        try:
            # Nobody changes its parameters, and requests that are malformed cannot end it.
            node = Node(name, start_parameter_services=False)
        except RuntimeError as error:
            raise ContactReachError(f"ROS cannot start node {name}: {error}") from error
        end.callback(node.destroy_node)
        yield node


def described(robot: str, node_name: str, discovery: str = "host", arguments: Sequence[str] = ()) -> str:
    """The path of the file that holds an arm whose description is published; any other arm as it is.

    Raises `SettingsError` as `description_file`.

    Parameters
    ----------
    robot
        A name or path, as for `load_arm`, or what stands for a description, see `options_of`.
    node_name
        Of the node that asks.
    discovery
        How far it can be heard, one of `discovery.CHOICES`, unless the environment says so.
    arguments
        Its command line, program name first: in whose namespace, and with which remappings.
    """
    if options_of(robot) is None:
        return robot
    os.environ.update(environment(discovery))
    with bare_node(f"{node_name}_description", arguments) as node:
        return description_file(node, robot)


def with_description(arguments: Sequence[str], node_name: str) -> list[str]:
    """The command line of a node, with the path of a file for an arm whose description is published.

    Raises `SettingsError` as `described`.
    """
    given = given_parameters(arguments, node_name)
    robot = str(given.get(ROBOT.name, ""))
    path = described(robot, node_name, str(given.get("discovery", "host")), arguments)
    return [*arguments, *(["--ros-args", *as_arguments({ROBOT.name: path})] if path != robot else [])]


def _serve(node: ManagedNode) -> int:
    """Loop and executor in a thread each; the main thread looks for a signal now and then, which wakes no other.

    An executor that had to look for signals would be awake more often than all it serves needs.
    """
    asked: list[tuple[int, float]] = []
    served = Future()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    cpus = choose_cpus(node.cpus, node.role, os.sched_getaffinity(0))
    # Until the node is configured a signal ends it at once: compiling, for one, takes long and cannot be interrupted.
    end_at_signals()
    if node.autostart and not _succeeds(node, node.trigger_configure):
        return 1

    def ask(number: int, _: object) -> None:
        if not asked:
            # Not when the main thread looks: the arm may be moving.
            node.may_end(insists=False)
        asked.append((number, time.monotonic()))

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # nohup has it ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, ask)

    def may_end() -> bool:
        first = asked[0][1]
        return node.may_end(any(number == signal.SIGINT and at - first >= _AGAIN_S for number, at in asked))

    if node.autostart and not _succeeds(node, node.trigger_activate):
        return 1
    # Also the first use of the logger, which takes long.
    node.get_logger().info("active" if node.running else "waiting to be configured")
    node.boundary.protect(node)
    use_cpus(cpus)
    warning = take_priority(node.role)
    if warning:
        node.get_logger().warning(warning)

    def serve() -> None:
        give_way()
        executor.spin_until_future_complete(served)

    with ThreadPoolExecutor(2) as pool:
        tasks = [pool.submit(node.loop), pool.submit(serve)]
        try:
            while not (any(task.done() for task in tasks) or (asked and may_end())):
                # With a limit: Linux may give the signal to another thread, and Python handles it in this one.
                time.sleep(_LOOK_S)
        finally:
            # Another Ctrl-C would end Python's last moments as if it had failed: launch sends one after the terminal's.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            node.request_stop()
            served.set_result(None)
            wait(tasks)
            executor.shutdown()
            if node.inbox.intake is not None:
                node.inbox.intake.flush()
            node.write_out()
    failures = [error for error in (task.exception() for task in tasks) if error is not None]
    if failures:
        node.get_logger().fatal(f"the node ended with {type(failures[0]).__name__}: {failures[0]}")
        return 1
    return 0


def _succeeds(node: ManagedNode, transition: Callable[[], TransitionCallbackReturn]) -> bool:
    """Whether a transition of the node's lifecycle succeeds; if it does not, that is logged."""
    is_done = transition() == TransitionCallbackReturn.SUCCESS
    if not is_done:
        node.get_logger().fatal(f"{transition.__name__.removeprefix('trigger_')} failed; see the message above")
    return is_done
