"""The format of bags: topics, their types and quality of service, and where rosbag2 keeps the metadata."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from contact_reach_ros.errors import BagError

ROS2MSG = "ros2msg"
"""Language of .msg files, the only one of definitions that is read and written here."""
LOST = "messages_lost"
"""Key of a bag's custom data for the number of lost messages; with a topic's name appended, those of that topic."""
CDR = "cdr"
"""Serialisation of ROS 2 messages."""
MCAP_NAME, MCAP_KEY = "rosbag2", "serialized_metadata"
"""Record and key under which rosbag2 keeps a copy of the metadata inside the mcap file."""

_UNLIMITED = {"sec": 9223372036, "nsec": 854775807}
"""ROS's value for a duration without limit, as rosbag2 writes it."""


@dataclasses.dataclass(frozen=True)
class OfferedQos:
    """The quality of service that a publisher offers, in the words of a rosbag2 file (version 9)."""

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"


def read_offered_qos(text: str) -> tuple[OfferedQos, ...]:
    """Read the profiles that an mcap channel holds as YAML; empty if there are none, or none that can be read."""
    try:
        return tuple(
            OfferedQos(qos.history.name.lower(), qos.depth, qos.reliability.name.lower(), qos.durability.name.lower())
            for qos in parse_qos(text)
        )
    except (ReaderError, KeyError, TypeError, AttributeError):
        return ()


def written_qos(offered: Iterable[OfferedQos]) -> list[dict[str, Any]]:
    """Return profiles as rosbag2 writes them, with its defaults for deadline, lifespan and liveliness."""
    rest = {
        "deadline": _UNLIMITED,
        "lifespan": _UNLIMITED,
        "liveliness": "automatic",
        "liveliness_lease_duration": _UNLIMITED,
        "avoid_ros_namespace_conventions": False,
    }
    return [dataclasses.asdict(qos) | rest for qos in offered]


@dataclasses.dataclass(frozen=True)
class RecordedTopic:
    """A topic of a bag.

    Attributes
    ----------
    name :
        Full name.
    type :
        Such as sensor_msgs/msg/JointState.
    offered_qos :
        Quality of service that its publishers offered.
    encoding :
        How its messages are serialised.
    message_count :
        Number of its messages in a bag that was read.
    """

    name: str
    type: str
    offered_qos: tuple[OfferedQos, ...] = ()
    encoding: str = CDR
    message_count: int = 0


def check_type_name(name: str) -> str:
    """Return `name` if it reads package/msg/Type; raises `BagError` if it does not."""
    parts = name.split("/")
    if len(parts) != 3 or parts[1] != "msg" or not all(part.isidentifier() for part in parts):
        raise BagError(f"message type '{name}': expected package/msg/Type, as in sensor_msgs/msg/JointState")
    return name
