"""Two bare nodes that exchange the loop's messages, which shows how much time ROS itself takes.

`ping` sends joint states as the driver does; `pong` answers each with a command as an ordinary rclpy node would, by a
callback in an executor, with message objects. Names are below /bench, where nothing that moves an arm listens.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Sequence

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.inbox import Inbox
from contact_reach_ros.ros.process import run_measurement
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.ros.scheduling import (
    CONTROLLER_PRIORITY,
    DRIVER_PRIORITY,
    Role,
    choose_cpus,
    isolated_cpus,
    request_realtime,
    use_cpus,
)
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.timing import Histogram, percentiles_us
from contact_reach_ros.units import NANOSECONDS

PING, PONG = "ping", "pong"

_STATES = Topic("/bench/echo/states", JointState)
_ANSWERS = Topic("/bench/echo/answers", Float64MultiArray)
_TICK_NS = round(TICK * NANOSECONDS)
_WARM_UP_NS = NANOSECONDS
_PATIENCE_S = 15.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of the two: `ping` prints percentiles of the round trip in µs as JSON, `pong` answers until SIGTERM."""
    parser = argparse.ArgumentParser(prog="echo", description="Round trips of bare rclpy nodes.")
    parser.add_argument("role", choices=(PING, PONG))
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args(arguments)
    sys.setswitchinterval(2e-4)
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: ended.append(number))
    if options.role == PING:
        run_measurement(f"echo_{PING}", lambda node: _ping(node, load_arm(), options.seconds, ended))
    else:
        run_measurement(f"echo_{PONG}", lambda node: _pong(node, ended))


def _ping(node: Node, arm: Arm, seconds: float, ended: list[int]) -> dict[str, float]:
    publisher = node.create_publisher(_STATES.type, _STATES.name, qos_profile(_STATES.qos))
    inbox = Inbox(node, _fail)
    trips = Histogram()
    sent_ns = 0
    counting = False

    def answered(_: bytes) -> None:
        nonlocal sent_ns
        if sent_ns and counting:
            trips.add(max(inbox.received_ns - sent_ns, 0))
        sent_ns = 0

    inbox.add(_ANSWERS, answered, topics.NEWEST, serialized=True)
    deadline = time.monotonic() + _PATIENCE_S
    while not (publisher.get_subscription_count() and node.count_publishers(_ANSWERS.name)):
        if time.monotonic() > deadline:
            raise ContactReachError(f"nobody answers on {_ANSWERS.name} after {_PATIENCE_S:.0f} s")
        time.sleep(0.1)
    writer = JointStateWriter(arm.joint_names, "", ("position", "velocity", "effort"))
    values = np.array(arm.home)
    _in_real_time(DRIVER_PRIORITY)
    begin_ns = due_ns = time.monotonic_ns()
    while due_ns < begin_ns + _WARM_UP_NS + seconds * NANOSECONDS and not ended:
        due_ns += _TICK_NS
        time.sleep(max(due_ns - time.monotonic_ns(), 0) / NANOSECONDS)
        inbox.poll()
        counting = due_ns > begin_ns + _WARM_UP_NS
        sent_ns = time.time_ns()
        publisher.publish(writer.write(sent_ns, values, values, values))
    if trips.count == 0:
        raise ContactReachError(f"no answer on {_ANSWERS.name} within {seconds:g} s")
    return percentiles_us(trips.counts())


def _pong(node: Node, ended: list[int]) -> None:
    publisher = node.create_publisher(_ANSWERS.type, _ANSWERS.name, qos_profile(_ANSWERS.qos))

    def answer(message: JointState) -> None:
        publisher.publish(Float64MultiArray(data=message.effort))

    node.create_subscription(_STATES.type, _STATES.name, answer, qos_profile(topics.NEWEST))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    _in_real_time(CONTROLLER_PRIORITY)
    while not ended:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()


def _fail(_: str, error: Exception) -> None:
    raise error


def _in_real_time(priority: int) -> None:
    use_cpus(choose_cpus("auto", Role.LOOP, os.sched_getaffinity(0), isolated_cpus()))
    request_realtime(priority)


if __name__ == "__main__":
    main()
