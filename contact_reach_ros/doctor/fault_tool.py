"""Makes things go wrong in the running stack: `ros2 run contact_reach_ros faults`."""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import Pose, PoseStamped, Transform, Vector3
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header, String
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import DEFAULT_ARM, load_arm
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_duration, to_point, to_time
from contact_reach_ros.resources import PACKAGE
from contact_reach_ros.ros.interfaces import INTERFACES
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.simulation.fault_kinds import kinds_table
from contact_reach_ros.simulation.fault_schedules import driver_faults

NAME = "faults"

NODES = ("driver", "adapter", "controller", "observer", "planner", "recorder")
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
WHATS = ("nan", "garbage", "zeros")

_GARBAGE = bytes(range(64))
"""No message of any type: the first bytes name no encoding."""
_DISCOVERY_S = 5.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line, and exit with 0, or with 2 and a line that names what is wrong."""
    options = make_parser().parse_args(sys.argv[1:] if arguments is None else arguments)
    try:
        options.act(options)
    except ContactReachError as error:
        print(f"{NAME}: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = argparse.ArgumentParser(prog=NAME, description="Makes things go wrong in the running stack.")
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    send = actions.add_parser("send", help="send a schedule to the simulated driver, in place of the current one")
    send.add_argument("schedule", help="faults; see docs/faults.md")
    send.set_defaults(act=lambda options: send_schedule(options.schedule, load_arm(options.arm)))
    clear = actions.add_parser("clear", help="end all faults in the simulated driver")
    clear.set_defaults(act=lambda options: send_schedule("", load_arm()))
    for action, number in SIGNALS.items():
        does = actions.add_parser(action, help=f"{number.name} to the process of a node on this machine")
        does.add_argument("node", choices=NODES)
        does.set_defaults(act=lambda options, number=number: signal_node(options.node, number))
    publish = actions.add_parser("publish", help="disturb a topic as a second publisher")
    publish.add_argument("topic", choices=[topic.name for topic in ATTACKED])
    publish.add_argument("what", choices=WHATS)
    publish.add_argument("--rate", type=float, default=100.0, help="messages per second (default: 100)")
    publish.add_argument("--for", dest="seconds", type=float, default=1.0, help="how long, s (default: 1)")
    publish.set_defaults(
        act=lambda options: disturb(options.topic, options.what, options.rate, options.seconds, load_arm(options.arm))
    )
    kinds = actions.add_parser("kinds", help="list the kinds of faults in a schedule and their keys")
    kinds.set_defaults(act=lambda options: print(kinds_table(load_arm(options.arm)), end=""))
    for of_arm in (send, publish, kinds):
        of_arm.add_argument("--arm", default=DEFAULT_ARM, help="the stack's: a name, or a file (default: iiwa14)")
    return parser


def send_schedule(text: str, arm: Arm) -> None:
    """Send a schedule to the simulated driver; an empty one ends all faults.

    Raises
    ------
    SettingsError
        If it is no schedule that the driver can play.
    InputError
        If no simulated driver listens.
    """
    schedule = "; ".join(fault.text() for fault in driver_faults(text, arm))

    with bare_node(NAME) as node:
        publisher = node.create_publisher(
            topics.SIM_FAULTS.type, topics.SIM_FAULTS.name, qos_profile(topics.SIM_FAULTS.qos)
        )
        if not _until(node, lambda: publisher.get_subscription_count() > 0):
            raise InputError(
                f"no simulated driver listens on {topics.SIM_FAULTS.name}: start the stack with driver:=true; a real "
                "robot's driver takes no faults"
            )
        publisher.publish(String(data=schedule))
        publisher.wait_for_all_acked()
    print(f"sent: {schedule or 'no faults'}")


_MODULE = re.compile(rf"{PACKAGE}\.(?:nodes|bringup)\.(\w+)")
_NAMESPACE = "__ns:="
_PROC = Path("/proc")


def node_processes(
    domain: str, proc: Path = _PROC, user: int | None = None, namespace: str | None = None
) -> dict[int, str]:
    """Find the processes of this package's nodes in a ROS domain; returns the node's name by process id.

    Parameters
    ----------
    domain
        ROS_DOMAIN_ID.
    proc
        Where procfs is mounted.
    user
        Who owns the processes; None for everybody whose processes may be looked at.
    namespace
        Of the nodes; None for any.
    """
    found = {}
    for folder in proc.iterdir():
        if not folder.name.isdigit():
            continue
        try:
            if user is not None and folder.stat().st_uid != user:
                continue
            arguments = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            env = (folder / "environ").read_bytes().split(b"\0")
        except OSError:  # ended meanwhile, or another user's
            continue
        name = _node_name(arguments)
        domains = [entry.partition(b"=")[2].decode() for entry in env if entry.startswith(b"ROS_DOMAIN_ID=")]
        spaces = [argument.removeprefix(_NAMESPACE) for argument in arguments if argument.startswith(_NAMESPACE)]
        if namespace is not None and (spaces or ["/"])[-1] != namespace:
            continue
        if name and (domains or ["0"])[0] == domain:
            found[int(folder.name)] = name
    return found


def _node_name(arguments: list[str]) -> str:
    """Name of the node that a command line runs, by `python -m` or as an executable; empty if it runs none."""
    for index, argument in enumerate(arguments[:4]):
        module = _MODULE.fullmatch(argument) if index and arguments[index - 1] == "-m" else None
        # As the script of an interpreter, or below the package's own folder for executables.
        executable = argument.startswith("/") and (index == 1 or f"/{PACKAGE}/" in argument)
        name = module[1] if module else argument.rpartition("/")[2] if executable else ""
        if name in INTERFACES:
            return name
    return ""


def signal_node(name: str, number: signal.Signals) -> None:
    """Send a signal to the process of a node of this machine, user and ROS domain.

    Raises `InputError` if there is no such process, or several.
    """
    processes = node_processes(os.environ.get("ROS_DOMAIN_ID", "0"), user=os.getuid())
    found = sorted(process for process, node in processes.items() if node == name)
    if len(found) != 1:
        what = "no process" if not found else f"{len(found)} processes ({', '.join(map(str, found))})"
        raise InputError(f"{what} of node {name} in this ROS domain on this machine; expected exactly one")
    os.kill(found[0], number)
    print(f"{number.name} to {name}, process {found[0]}")


def disturb(name: str, what: str, rate: float, seconds: float, arm: Arm) -> int:
    """Publish on a topic besides its own publisher; returns the number of messages.

    Raises `InputError` if nobody listens.

    Parameters
    ----------
    name
        One of `ATTACKED`.
    what
        `nan`: messages whose numbers are NaN; `zeros`: well-formed ones whose numbers are zero; `garbage`: bytes that
        are no message.
    rate
        Messages per second.
    seconds
        How long.
    arm
        The stack's.
    """
    if not (0.1 <= rate <= 5000.0 and 0.0 < seconds <= 3600.0):
        raise InputError(f"rate {rate:g}, for {seconds:g}: expected 0.1 to 5000 messages per second, for up to 3600 s")
    topic = next(topic for topic in ATTACKED if topic.name == name)
    value = float("nan") if what == "nan" else 0.0
    count = 0
    with bare_node(NAME) as node:
        publisher = node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
        if not _until(node, lambda: publisher.get_subscription_count() > 0):
            raise InputError(f"nobody listens on {topic.name}: start the stack first, in the same ROS domain")
        began = time.monotonic()
        while (now := time.monotonic() - began) < seconds:
            now_ns = node.get_clock().now().nanoseconds
            publisher.publish(_GARBAGE if what == "garbage" else spoilt_message(topic, value, now_ns, arm))
            count += 1
            time.sleep(max(count / rate - now, 0.0))
    print(f"{count} messages ({what}) on {topic.name}")
    return count


def spoilt_message(topic: topics.Topic, value: float, now_ns: int, arm: Arm) -> Any:
    """Make a well-formed message of a topic whose numbers are all `value`."""
    header = Header(frame_id=arm.base_frame, stamp=to_time(now_ns))
    joints, values, end = list(arm.joint_names), [value] * arm.n, to_duration(100_000_000)
    point, vector = to_point([value] * 3), Vector3(x=value, y=value, z=value)
    knot = MultiDOFJointTrajectoryPoint(transforms=[Transform(translation=vector)], time_from_start=end)
    posture = JointTrajectoryPoint(positions=values, time_from_start=end)
    sphere = Marker(header=header, ns="obstacles", type=Marker.SPHERE, pose=Pose(position=point), scale=vector)
    return {
        topics.COMMANDS: Float64MultiArray(data=values),
        topics.JOINT_STATES: JointState(header=header, name=joints, position=values, velocity=values, effort=values),
        topics.REFERENCE_POSE: MultiDOFJointTrajectory(header=header, joint_names=[arm.tip_frame], points=[knot]),
        topics.REFERENCE_POSTURE: JointTrajectory(header=header, joint_names=joints, points=[posture]),
        topics.GOAL_POSE: PoseStamped(header=header, pose=Pose(position=point)),
        topics.OBSTACLES: MarkerArray(markers=[sphere]),
    }[topic]


def _until(node: Node, condition: Callable[[], bool]) -> bool:
    """Wait until discovery makes a condition true, for 5 s at most; returns whether it is."""
    end = time.monotonic() + _DISCOVERY_S
    while not condition():
        if time.monotonic() > end:
            return False
        rclpy.spin_once(node, timeout_sec=0.05)
    return True


if __name__ == "__main__":
    main()
