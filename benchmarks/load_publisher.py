"""Publishes the stack's fast topics without a stack, for `contact-reach bench bags`.

Names are below /bench, where nothing that moves an arm listens. Every message has its number in it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import InputError
from contact_reach_ros.experiments.bench_bags import NAMESPACE
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import CommandWriter, JointStateWriter, WrenchWriter
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.process import run_measurement
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.ros.scheduling import request_realtime
from contact_reach_ros.units import NANOSECONDS

NAME = "load"
PRIORITY = 40
_PATIENCE_S = 30.0
_PERIOD_NS = 1_000_000


class Stream(NamedTuple):
    """One topic, and a function that makes a message of its number and three random values for each joint."""

    topic: Topic
    write: Callable[[int, np.ndarray], bytes]


def streams(arm: Arm) -> list[Stream]:
    """Make the topics that the stack publishes at 1 kHz, or nearly."""
    joints, n = arm.joint_names, arm.n
    bodies = [*arm.contact_links, "sum", "max"]
    states = JointStateWriter(joints, "", ("position", "velocity", "effort"))
    torques = JointStateWriter(joints, "", ("effort",))
    contacts = JointStateWriter(bodies, "", ("effort",))
    wrenches, commands = WrenchWriter(arm.tip_frame), CommandWriter(n)
    return [
        Stream(topics.JOINT_STATES, lambda k, v: states.write(k, v[:n], v[n : 2 * n], v[2 * n : 3 * n])),
        Stream(topics.COMMANDS, lambda k, v: commands.write(np.append(float(k), v[1:n]))),
        Stream(topics.EXTERNAL_TORQUE, lambda k, v: torques.write(k, v[:n])),
        Stream(topics.EXTERNAL_WRENCH, lambda k, v: wrenches.write(k, v[:6])),
        Stream(topics.SIM_CONTACTS, lambda k, v: contacts.write(k, v[: len(bodies)])),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Wait for a subscriber of all topics, publish, and print the number of messages as JSON."""
    parser = argparse.ArgumentParser(prog=NAME, description="Publishes fast topics for a benchmark.")
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args(arguments)
    run_measurement(NAME, lambda node: _publish(node, options.seconds))


def _publish(node: Node, seconds: float) -> dict[str, float]:
    arm = load_arm()
    load = streams(arm)
    publishers = [
        node.create_publisher(stream.topic.type, f"{NAMESPACE}/{stream.topic.name}", qos_profile(stream.topic.qos))
        for stream in load
    ]
    deadline = time.monotonic() + _PATIENCE_S
    while not all(publisher.get_subscription_count() for publisher in publishers):
        if time.monotonic() > deadline:
            raise InputError(f"after {_PATIENCE_S:.0f} s nobody hears {NAMESPACE}: start the recorder first")
        time.sleep(0.05)
    random = np.random.default_rng(0)
    values = random.standard_normal((1000, 3 * arm.n))
    print("publishing", flush=True)
    request_realtime(PRIORITY)
    ticks, late = round(seconds * NANOSECONDS / _PERIOD_NS), 0
    began = time.monotonic_ns()
    for tick in range(ticks):
        due = began + tick * _PERIOD_NS
        remaining = due - time.monotonic_ns()
        if remaining > 0:
            time.sleep(remaining / NANOSECONDS)
        elif remaining < -_PERIOD_NS:
            late += 1
        row = values[tick % len(values)]
        for stream, publisher in zip(load, publishers, strict=True):
            publisher.publish(stream.write(tick, row))
    took = (time.monotonic_ns() - began) / NANOSECONDS
    for publisher in publishers:
        publisher.wait_for_all_acked(Duration(seconds=_PATIENCE_S))
    return {"ticks": ticks, "late_ticks": late, "seconds": took}


if __name__ == "__main__":
    main()
