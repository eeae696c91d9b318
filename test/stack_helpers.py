"""Running the stack in tests: real processes on a ROS domain of their own, or nodes in this one."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from arm_simulation import ARM, HOME, REST, TICK_NS
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from ros_domains import fresh_domain

from contact_reach_ros.executables import end_with_parent
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import joint_state_writer
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.inbox import Inbox, qos_profile
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import without_parameters
from contact_reach_ros.settings import NODES

SAMPLE = Path(__file__).parents[1] / "bags" / "sample"
"""The bag that the package ships: the arm touches a ball."""
SMALL_PLANNER = {"planning": {"population": 32, "max_steps": 3}}
"""Plans in a fraction of the time; the programs are those of `planning_helpers.SMALL`, which are compiled only once."""
PATIENT_PLANNER = {**SMALL_PLANNER, "latency": 0.25}
"""For real time: with less than a quarter of a second for each plan a busy machine makes every plan too late to take
effect, until the controller stops the arm before it has moved."""
UNWATCHED = "supervision.require_observer:=false"
"""Parameter of a controller that moves an arm without an observer."""


def environment() -> dict[str, str]:
    """Environment of a domain that no other test uses."""
    # Discovery is left to the package's own default, as a user has it.
    inherited = {name: value for name, value in os.environ.items() if name != "ROS_AUTOMATIC_DISCOVERY_RANGE"}
    return {**inherited, "ROS_DOMAIN_ID": str(fresh_domain()), "RCUTILS_COLORIZED_OUTPUT": "0"}


def parameter_file(path: Path, **nodes: dict) -> Path:
    """Write a parameter file with the given parameters by node."""
    path.write_text(yaml.safe_dump({name: {"ros__parameters": content} for name, content in nodes.items()}))
    return path


def module(name: str) -> list[str]:
    """Command that runs a module of the package."""
    return [sys.executable, "-m", f"contact_reach_ros.{name}"]


def prefix(folder: Path, command: str = "-m contact_reach_ros.nodes.{}") -> dict[str, str]:
    """Make a folder in which launch finds the executables of the nodes; returns the variable that names it.

    `command`: what Python runs for a node, in place of whose name are braces.
    """
    index, executables = folder / "share/ament_index/resource_index/packages", folder / "lib/contact_reach_ros"
    index.mkdir(parents=True)
    executables.mkdir(parents=True)
    (index / "contact_reach_ros").touch()
    for name in NODES:
        file = executables / name
        file.write_text(f'#!/bin/sh\nexec {sys.executable} {command.format(name)} "$@"\n')
        file.chmod(0o755)
    return {"AMENT_PREFIX_PATH": str(folder)}


@contextmanager
def ros(*parameters: str, more: Sequence[str] = (), domain: str | None = None) -> Iterator[None]:
    """Start rclpy in this process with parameters (name:=value) and more ROS arguments, in a domain of its own."""
    arguments = [part for parameter in parameters for part in ("-p", parameter)]
    given = ["test", "--ros-args", *arguments, *more]
    rclpy.init(args=without_parameters(given), domain_id=int(domain or environment()["ROS_DOMAIN_ID"]))
    ManagedNode.ARGUMENTS = given
    try:
        yield
    finally:
        ManagedNode.ARGUMENTS = ()
        rclpy.shutdown()


def hand_in(inbox: Inbox, topic: Topic, data: bytes) -> None:
    """Have an inbox handle the bytes of a message as if they had just arrived."""
    # Of two subscriptions to a topic one gets it first.
    found = [each for each in (*inbox._subscriptions, *inbox._unhurried) if each.topic.name == topic.name]
    for listened in found[:1]:
        inbox._handle(listened, data, time.time_ns())


class AtRest:
    """Gives a node the joint states of an arm at rest at home, one a tick."""

    def __init__(self, node: Node) -> None:
        self._node, self._ticks = node, itertools.count(1)
        self._writer = joint_state_writer(ARM.joint_names, ARM.base_frame, ["position", "velocity", "effort"])

    def give(self, count: int = 1, torque: np.ndarray = REST) -> None:
        """`torque`: measured at the joints, (n,), N m."""
        for tick in itertools.islice(self._ticks, count):
            # As encoders tell it; without any tremor they would be stuck.
            data = self._writer.write(HOME + 1e-5 * (tick % 2), REST, torque, stamp_ns=tick * TICK_NS)
            hand_in(self._node.inbox, topics.JOINT_STATES, data)
            self._node.inbox.run_tasks()


class Beside:
    """A node whose timers run when the test lets them, and another node."""

    def __init__(self, node: ManagedNode) -> None:
        self.node, self.other = node, rclpy.create_node("intruder", use_global_arguments=False)
        node.boundary.protect(node)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(node)
        self.executor.add_node(self.other)

    def publish(self, topic: Topic, by: Node | None = None) -> Publisher:
        """A publisher of the other node, or a third one; in lockstep what it publishes is kept."""
        qos = topics.KEPT_STREAM if self.node.lockstep and not topic.qos.latched else topic.qos
        return (by or self.other).create_publisher(topic.type, topic.name, qos_profile(qos))

    def until(self, condition: Callable[[], object], what: str, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Let the nodes work until the condition holds."""
        for _ in range(500):
            if condition():
                return
            meanwhile()
            self.executor.spin_once(0.05)
            self.node.inbox.run_tasks()
        pytest.fail(f"not within 500 turns: {what}")


class Published:
    """Stands for a publisher, and keeps what is published."""

    def __init__(self) -> None:
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        self.messages.append(message)


@contextmanager
def running(
    command: list[str], env: dict[str, str], output: Path, prepare: Callable[[], None] | None = None
) -> Iterator[subprocess.Popen]:
    """A process whose output goes to a file; interrupted, and if need be killed, at the end, or with the test run.

    `prepare` is called in it before it becomes the command.
    """

    def begin() -> None:
        end_with_parent()
        if prepare is not None:
            prepare()

    with output.open("wb") as file:
        process = subprocess.Popen(
            command, env=env, stdout=file, stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=begin
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                try:
                    process.wait(30)
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()


def wait_for(condition: Callable[[], object], timeout: float, what: str) -> None:
    """Poll until the condition holds; fails naming what did not happen."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"not within {timeout:.0f} s: {what}"
        time.sleep(0.05)


def ready(process: subprocess.Popen, output: Path, marker: str = "all nodes are active") -> None:
    """Wait until a process has printed that it is up."""
    wait_for(lambda: marker in output.read_text() or process.poll() is not None, 300, marker)
    assert process.poll() is None, output.read_text()


def speeds_until(domain: str, holds: Callable[[list[float]], bool], timeout: float = 30.0) -> bool:
    """Whether this holds in time for the speeds of the fastest joint, rad/s, that are heard in a ROS domain."""
    speeds = [0.0]
    with ros(domain=domain):
        look = rclpy.create_node("look")
        topic, qos = topics.JOINT_STATES, qos_profile(topics.NEWEST)
        look.create_subscription(
            topic.type, topic.name, lambda state: speeds.append(max(map(abs, state.velocity))), qos
        )
        deadline = time.monotonic() + timeout
        while not holds(speeds) and time.monotonic() < deadline:
            rclpy.spin_once(look, timeout_sec=0.1)
    return holds(speeds)


_MANY = """
import json, sys
from contact_reach_ros.cli import main

for line in json.loads(sys.argv[1]):
    try:
        main(line.split())
    except SystemExit as ended:
        print(ended.code, flush=True)
"""


def command_lines(env: dict[str, str], *lines: str, timeout: float = 400.0) -> list[tuple[int, str]]:
    """Run command lines in one process; returns the exit code of each, with the last line that it printed."""
    command = [sys.executable, "-c", _MANY, json.dumps(lines)]
    result = subprocess.run(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=timeout
    )
    printed = result.stdout.splitlines()
    ends = [index for index, line in enumerate(printed) if line.isdecimal()]
    assert len(ends) == len(lines), result.stdout
    return [(int(printed[index]), printed[index - 1]) for index in ends]


def processes_of_domain(domain: str) -> dict[str, int]:
    """Ids of all processes of a ROS domain, by the name of the node module they run."""
    found = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            env = (folder / "environ").read_bytes().split(b"\0")
            arguments = (folder / "cmdline").read_bytes().decode().split("\0")
        except OSError:
            continue
        if f"ROS_DOMAIN_ID={domain}".encode() in env and "-m" in arguments:
            found[arguments[arguments.index("-m") + 1].rpartition(".")[2]] = int(folder.name)
    return found
