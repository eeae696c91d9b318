"""A tool that makes things go wrong in the running stack: `ros2 run contact_reach_ros faults`."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, Transform
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.driver import driver_faults
from contact_reach_ros.nodes.managed import initialise
from contact_reach_ros.nodes.messages import to_time
from contact_reach_ros.nodes.processes import PACKAGE
from contact_reach_ros.plant.fault_kinds import kinds_table
from contact_reach_ros.robot import iiwa14

NAME = "faults"

NODES = ("driver", "controller", "observer", "planner", "recorder")
SIGNALS = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP, "continue": signal.SIGCONT}

ATTACKED = (
    topics.COMMANDS,
    topics.JOINT_STATES,
    topics.REFERENCE_POSE,
    topics.REFERENCE_POSTURE,
    topics.GOAL_POSE,
    topics.OBSTACLES,
)
"""Topics that a second publisher can disturb."""
WHATS = ("nan", "garbage", "zeros", "duplicate")

_GARBAGE = bytes(range(64))
"""No message of any type: its first bytes name no encoding."""
_DISCOVERY_S = 5.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says, and exit with 0, or with 2 and what is wrong."""
    options = make_parser("faults").parse_args(sys.argv[1:] if arguments is None else arguments)
    try:
        options.act(options)
    except ContactReachError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def make_parser(program: str) -> argparse.ArgumentParser:
    """What the command line may be."""
    parser = argparse.ArgumentParser(prog=program, description="Makes things go wrong in the running stack.")
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    send = actions.add_parser("send", help="send a schedule to the simulated driver, instead of the one at hand")
    send.add_argument("schedule", help="faults, or their YAML file; see docs/faults.md")
    send.set_defaults(act=lambda options: send_schedule(options.schedule))
    clear = actions.add_parser("clear", help="end all faults in the simulated driver")
    clear.set_defaults(act=lambda options: send_schedule(""))
    for action, number in SIGNALS.items():
        does = actions.add_parser(action, help=f"{number.name} to the process of a node on this machine")
        does.add_argument("node", choices=NODES)
        does.set_defaults(act=lambda options, number=number: signal_node(options.node, number))
    publish = actions.add_parser("publish", help="disturb a topic as a second publisher")
    publish.add_argument("topic", choices=[topic.name for topic in ATTACKED])
    publish.add_argument("what", choices=WHATS)
    publish.add_argument("--rate", type=float, default=100.0, help="messages per second (default: 100)")
    publish.add_argument("--for", dest="seconds", type=float, default=1.0, help="how long, s (default: 1)")
    publish.set_defaults(act=lambda options: disturb(options.topic, options.what, options.rate, options.seconds))
    kinds = actions.add_parser("kinds", help="list the kinds of faults in a schedule and their keys")
    kinds.set_defaults(act=lambda options: print(kinds_table(), end=""))
    return parser


def send_schedule(text: str) -> None:
    """Send a schedule to the simulated driver; an empty one ends all faults.

    Raises
    ------
    SettingsError
        If it is no schedule that the driver can play.
    InputError
        If no simulated driver listens.
    """
    # The driver may run elsewhere: it gets the faults themselves, not the path of a file.
    schedule = "; ".join(fault.text() for fault in driver_faults(text))

    def act(node: Node) -> None:
        publisher = node.create_publisher(topics.SIM_FAULTS.type, topics.SIM_FAULTS.name, topics.SIM_FAULTS.qos)
        if not _until(node, lambda: publisher.get_subscription_count() > 0):
            raise InputError(
                f"no simulated driver listens on {topics.SIM_FAULTS.name}: start the stack with driver:=true; a real "
                "robot's driver takes no faults"
            )
        publisher.publish(String(data=schedule))
        publisher.wait_for_all_acked()

    _with_node(act)
    print(f"sent: {schedule or 'no faults'}")


def signal_node(name: str, number: signal.Signals) -> None:
    """Send a signal to the process of a node of this machine, user and ROS domain.

    Raises
    ------
    InputError
        If there is no such process, or several.
    """
    found = node_processes(name, Path("/proc"), os.environ.get("ROS_DOMAIN_ID", "0"), os.getuid())
    if len(found) != 1:
        what = "no process" if not found else f"{len(found)} processes ({', '.join(map(str, found))})"
        raise InputError(f"{what} of node {name} in this ROS domain on this machine; expected exactly one")
    os.kill(found[0], number)
    print(f"{number.name} to {name}, process {found[0]}")


def node_processes(name: str, proc: Path, domain: str, user: int) -> list[int]:
    """Ids of the processes of a user and a ROS domain that run a node of the package."""
    found = []
    for folder in proc.iterdir():
        if not folder.name.isdigit():
            continue
        try:
            if folder.stat().st_uid != user:
                continue
            arguments = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            variables = (folder / "environ").read_bytes().split(b"\0")
        except OSError:
            # It ended meanwhile, or is none of this user's.
            continue
        values = [value.partition(b"=")[2].decode() for value in variables if value.startswith(b"ROS_DOMAIN_ID=")]
        if _runs(arguments, name) and (values or ["0"])[0] == domain:
            found.append(int(folder.name))
    return sorted(found)


def _runs(arguments: Sequence[str], name: str) -> bool:
    """Whether a command line runs a node: by its module, as bring-up does, or by its executable."""
    for index, argument in enumerate(arguments[:3]):
        if argument == "-m":
            return arguments[index + 1 : index + 2] == [f"{PACKAGE}.nodes.{name}"]
        if Path(argument).name == name and (index == 1 or PACKAGE in argument):
            return True
    return False


def disturb(name: str, what: str, rate: float, seconds: float) -> int:
    """Publish on a topic besides its own publisher; returns the number of messages.

    Parameters
    ----------
    name
        One of `ATTACKED`.
    what
        `nan`: messages whose numbers are NaN; `zeros`: well-formed ones that ask for nothing; `garbage`: bytes that are
        no message; `duplicate`: what comes on the topic, once more.
    rate
        Messages per second; for `duplicate` each message comes once more.
    seconds
        How long.

    Raises
    ------
    InputError
        If nobody listens, or there is nothing to duplicate.
    """
    if not (0.1 <= rate <= 5000.0 and 0.0 < seconds <= 3600.0):
        raise InputError(f"rate {rate:g}, for {seconds:g}: expected 0.1 to 5000 messages per second, for up to 3600 s")
    topic = next(topic for topic in ATTACKED if topic.name == name)
    count = 0

    def act(node: Node) -> None:
        nonlocal count
        publisher = node.create_publisher(topic.type, topic.name, topic.qos)
        if not _until(node, lambda: publisher.get_subscription_count() > 0):
            raise InputError(f"nobody listens on {topic.name}: start the stack first, in the same ROS domain")
        if what == "duplicate":
            count = _duplicate(node, topic, publisher, seconds)
            return
        began = time.monotonic()
        while (now := time.monotonic() - began) < seconds:
            if what == "garbage":
                publisher.publish(_GARBAGE)
            else:
                value = float("nan") if what == "nan" else 0.0
                publisher.publish(spoilt_message(topic, value, node.get_clock().now().nanoseconds))
            count += 1
            time.sleep(max(count / rate - now, 0.0))

    _with_node(act)
    print(f"{count} messages ({what}) on {topic.name}")
    return count


def _duplicate(node: Node, topic: topics.Topic, publisher: Any, seconds: float) -> int:
    """Publish what comes on a topic once more, but not what comes from here."""
    sent: list[bytes] = []
    count = 0

    def repeat(data: bytes) -> None:
        nonlocal count
        if data in sent:
            sent.remove(data)
            return
        # Only the last: equal bytes that never came back would swallow others.
        sent[:] = [*sent[-50:], data]
        publisher.publish(data)
        count += 1

    node.create_subscription(topic.type, topic.name, repeat, topic.qos, raw=True)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)
    if count == 0:
        raise InputError(f"nothing came on {topic.name} in {seconds:g} s, so there was nothing to duplicate")
    return count


def spoilt_message(topic: topics.Topic, value: float, now_ns: int) -> Any:
    """A well-formed message of a topic whose numbers are all `value`."""
    joints, values = list(iiwa14.JOINT_NAMES), [value] * iiwa14.N_JOINTS
    message: Any
    if topic is topics.COMMANDS:
        return Float64MultiArray(data=values)
    if topic is topics.JOINT_STATES:
        message = JointState(name=joints, position=values, velocity=values, effort=values)
    elif topic is topics.GOAL_POSE:
        message = PoseStamped()
        for axis in "xyz":
            setattr(message.pose.position, axis, value)
    elif topic is topics.REFERENCE_POSTURE:
        point = JointTrajectoryPoint(positions=values)
        point.time_from_start.nanosec = 100_000_000
        message = JointTrajectory(joint_names=joints, points=[point])
    elif topic is topics.REFERENCE_POSE:
        transform = Transform()
        for axis in "xyz":
            setattr(transform.translation, axis, value)
        knot = MultiDOFJointTrajectoryPoint(transforms=[transform])
        knot.time_from_start.nanosec = 100_000_000
        message = MultiDOFJointTrajectory(joint_names=[iiwa14.FLANGE_NAME], points=[knot])
    else:
        marker = Marker(ns="obstacles", type=Marker.SPHERE)
        marker.header.frame_id = iiwa14.BASE_NAME
        marker.header.stamp = to_time(now_ns)
        for axis in "xyz":
            setattr(marker.pose.position, axis, value)
            setattr(marker.scale, axis, value)
        return MarkerArray(markers=[marker])
    message.header.frame_id = iiwa14.BASE_NAME
    message.header.stamp = to_time(now_ns)
    return message


def _with_node(act: Callable[[Node], None]) -> None:
    initialise([NAME])
    node = Node(NAME)
    try:
        act(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _until(node: Node, condition: Callable[[], bool]) -> bool:
    """Wait for discovery; whether the condition holds."""
    end = time.monotonic() + _DISCOVERY_S
    while not condition():
        if time.monotonic() > end:
            return False
        rclpy.spin_once(node, timeout_sec=0.05)
    return True


if __name__ == "__main__":
    main()
