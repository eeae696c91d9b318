"""A robot's own description, which its driver publishes, as a file that `load_arm` reads."""

from __future__ import annotations

import hashlib
import os
import sys
import time
from pathlib import Path
from typing import Any

import yaml
from rclpy.node import Node

from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.messages.topics import ROBOT_DESCRIPTION, Qos
from contact_reach_ros.resources import cache_directory
from contact_reach_ros.ros.graph import node_of
from contact_reach_ros.ros.inbox import Inbox
from contact_reach_ros.settings import read_yaml
from contact_reach_ros.timing import NANOSECONDS

_PATIENCE_S = 5.0
_OTHERS_S = 0.5
"""Time after the first description in which one of another publisher comes."""
_URDF, _PACKAGES = "urdf", "packages"
"""Options of a robot's file, see `ArmOptions`."""


def options_of(robot: str) -> dict[str, Any] | None:
    """The options beside a robot's description, where `robot` stands for that; None where it is another arm.

    It is the topic's name, or the path of a YAML file whose key `urdf` has that name. Raises `SettingsError` if such a
    file cannot be read.
    """
    content = read_yaml(Path(robot)) if robot.lower().endswith((".yaml", ".yml")) else {_URDF: robot}
    return content if content.pop(_URDF, "") == ROBOT_DESCRIPTION.name else None


def description_file(node: Node, robot: str) -> str:
    """Wait until the robot's description is published, and write it, with its options, to the user's cache.

    Raises `SettingsError` if nobody publishes it, several nodes publish different ones, or it is not that of an arm.

    Parameters
    ----------
    node
        Listens, in its namespace and with its remappings.
    robot
        As for `options_of`.

    Returns
    -------
    str
        Path of the URDF, whose name follows from its content: what `load_arm` takes.
    """
    text, options = _hear(node), options_of(robot) or {}
    if isinstance(options.get(_PACKAGES), dict):
        beside = Path(robot).resolve().parent
        options[_PACKAGES] = {name: str(beside / folder) for name, folder in options[_PACKAGES].items()}
    files = {".yaml": yaml.safe_dump(options)} if options else {}
    # The URDF last: where it is, all is there.
    files[".urdf"] = text
    digest = hashlib.sha256("\0".join(files.values()).encode()).hexdigest()[:16]
    path, topic = cache_directory() / "descriptions" / digest, node.resolve_topic_name(ROBOT_DESCRIPTION.name)
    try:
        path.parent.mkdir(exist_ok=True)
        for suffix, content in files.items():
            new = path.with_suffix(f"{suffix}.{os.getpid()}")
            new.write_text(content, encoding="utf-8")
            new.replace(path.with_suffix(suffix))
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written ({error.strerror}); set XDG_CACHE_HOME") from error
    found = str(path.with_suffix(".urdf"))
    try:
        arm = load_arm(found)
    except SettingsError as error:
        own = f"a YAML file with the key {_URDF}: {robot}, whose path is then robot"
        where = own if robot == ROBOT_DESCRIPTION.name else robot
        raise SettingsError(f"the description on {topic}: {error}; its options belong in {where}") from error
    chain = f"{arm.n} joints from {arm.base_frame} to {arm.tip_frame}"
    node.get_logger().info(f"arm {arm.name}, {chain}, as described on {topic}: {found}")
    return found


def _hear(node: Node) -> str:
    """The description that is published."""
    topic, heard, inbox = ROBOT_DESCRIPTION, list[str](), Inbox(node, lambda what, error: None)
    inbox.add(topic, lambda message: heard.append(message.data), Qos(10, latched=True), largest=sys.maxsize)
    end = time.monotonic() + _PATIENCE_S
    while (left := end - time.monotonic()) > 0.0:
        nothing = not heard
        inbox.wait(int(left * NANOSECONDS))
        if nothing and heard:
            end = time.monotonic() + _OTHERS_S
    name = node.resolve_topic_name(topic.name)
    publishers = ", ".join(sorted(node_of(each) for each in node.get_publishers_info_by_topic(name)))
    if not heard:
        silent = f"published by {publishers}, but not latched (transient local)" if publishers else "nobody publishes"
        raise SettingsError(
            f"robot = {topic.name}: nothing came on {name} within {_PATIENCE_S:g} s ({silent}), in ROS domain "
            f"{os.environ.get('ROS_DOMAIN_ID', '0')}; start the driver or robot_state_publisher first, remap "
            f"{topic.name}, or give the path of a URDF as robot"
        )
    if len(set(heard)) > 1:
        raise SettingsError(
            f"robot = {topic.name}: {publishers} publish different descriptions on {name}; expected one: end or remap "
            "the others, or give the path of a URDF as robot"
        )
    return heard[0]
