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

from contact_reach_ros.errors import InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.managed import run_measurement
from contact_reach_ros.nodes.realtime import request_realtime
from contact_reach_ros.nodes.serialized import CommandWriter, JointStateWriter, WrenchWriter
from contact_reach_ros.nodes.topics import Topic
from contact_reach_ros.recording.load import NAMESPACE
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.units import NANOSECONDS

NAME = "load"
PRIORITY = 40
_BODIES = 9
_PATIENCE_S = 30.0


class Stream(NamedTuple):
    """One topic, and what makes a message of its number and 21 random values."""

    topic: Topic
    write: Callable[[int, np.ndarray], bytes]


def streams() -> list[Stream]:
    """The topics that the stack publishes at 1 kHz, or nearly."""
    joints, n = iiwa14.JOINT_NAMES, iiwa14.N_JOINTS
    states = JointStateWriter(joints, "", ("position", "velocity", "effort"))
    torques = JointStateWriter(joints, "", ("effort",))
    contacts = JointStateWriter([f"body_{body}" for body in range(_BODIES)], "", ("effort",))
    wrenches, commands = WrenchWriter(iiwa14.FLANGE_NAME), CommandWriter(n)
    return [
        Stream(topics.JOINT_STATES, lambda k, v: states.write(k, v[:n], v[n : 2 * n], v[2 * n : 3 * n])),
        Stream(topics.COMMANDS, lambda k, v: commands.write(np.append(float(k), v[1:n]))),
        Stream(topics.EXTERNAL_TORQUE, lambda k, v: torques.write(k, v[:n])),
        Stream(topics.EXTERNAL_WRENCH, lambda k, v: wrenches.write(k, v[:6])),
        Stream(topics.SIM_CONTACTS, lambda k, v: contacts.write(k, v[:_BODIES])),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Wait for somebody to hear all topics, say so, publish, and print how many messages there were as JSON."""
    parser = argparse.ArgumentParser(prog=NAME, description="Publishes fast topics for a benchmark.")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    options = parser.parse_args(arguments)
    run_measurement(NAME, lambda node: _publish(node, options.seconds, options.rate))


def _publish(node: Node, seconds: float, rate: float) -> dict[str, float]:
    load = streams()
    publishers = [
        node.create_publisher(stream.topic.type, f"{NAMESPACE}/{stream.topic.name}", stream.topic.qos)
        for stream in load
    ]
    deadline = time.monotonic() + _PATIENCE_S
    while not all(publisher.get_subscription_count() for publisher in publishers):
        if time.monotonic() > deadline:
            raise InputError(f"after {_PATIENCE_S:.0f} s nobody hears {NAMESPACE}: start the recorder first")
        time.sleep(0.05)
    random = np.random.default_rng(0)
    values = random.standard_normal((1000, 3 * iiwa14.N_JOINTS))
    print("publishing", flush=True)
    request_realtime(PRIORITY)
    ticks, late = int(seconds * rate), 0
    began = time.monotonic_ns()
    for tick in range(ticks):
        due = began + int(tick * NANOSECONDS / rate)
        remaining = due - time.monotonic_ns()
        if remaining > 0:
            time.sleep(remaining / NANOSECONDS)
        elif remaining < -NANOSECONDS / rate:
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
