"""Topics of a bag: their names, types and quality of service."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import yaml

from contact_reach_ros.errors import BagError
from contact_reach_ros.timing import NANOSECONDS

ROS2MSG = "ros2msg"
"""Language of .msg files, the only one of definitions that is read and written here."""
CDR = "cdr"
"""Serialisation of ROS 2 messages."""

INFINITE_NS = 2**63 - 1
"""ROS's value for a duration without limit, ns."""

_NUMBERED: Mapping[str, Mapping[Any, str]] = {
    "history": {0: "system_default", 1: "keep_last", 2: "keep_all", 3: "unknown"},
    "reliability": {0: "system_default", 1: "reliable", 2: "best_effort", 3: "unknown", 4: "best_available"},
    "durability": {0: "system_default", 1: "transient_local", 2: "volatile", 3: "unknown", 4: "best_available"},
    "liveliness": {0: "system_default", 1: "automatic", 3: "manual_by_topic", 4: "unknown", 5: "best_available"},
}
"""Meaning of rmw's numbers, which files up to version 8 have."""


def duration(nanoseconds: int) -> dict[str, int]:
    """Return a duration as rosbag2 writes it."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return {"sec": seconds, "nsec": rest}


def _unlimited() -> Any:
    return dataclasses.field(default_factory=lambda: duration(INFINITE_NS))


@dataclasses.dataclass(frozen=True)
class OfferedQos:
    """The quality of service that a publisher offers, in the names and words of a rosbag2 file (version 9).

    Durations are mappings of `sec` and `nsec`.
    """

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: Mapping[str, int] = _unlimited()
    lifespan: Mapping[str, int] = _unlimited()
    liveliness: str = "automatic"
    liveliness_lease_duration: Mapping[str, int] = _unlimited()
    avoid_ros_namespace_conventions: bool = False


def read_offered_qos(text: str) -> tuple[OfferedQos, ...]:
    """Read the profiles that an mcap channel holds as YAML; empty if there are none.

    Raises `BagError` if the text is something else.
    """
    try:
        profiles = yaml.safe_load(text) or []
        return tuple(
            OfferedQos(**{k: _NUMBERED[k].get(v, v) if k in _NUMBERED else v for k, v in profile.items()})
            for profile in profiles
        )
    except (yaml.YAMLError, TypeError, AttributeError) as error:
        raise BagError(f"quality of service {text!r}: expected profiles as in a rosbag2 file ({error})") from error


@dataclasses.dataclass(frozen=True)
class TypeDefinition:
    """Definition of a message type.

    Attributes
    ----------
    encoding :
        Language of the text, "ros2msg" or "ros2idl".
    text :
        The definition, followed by those of the types it contains.
    type_hash :
        RIHS01_<64 hexadecimal digits>, or empty.
    """

    encoding: str
    text: bytes
    type_hash: str


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
