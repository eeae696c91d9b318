"""Topics of a bag: their names, types and quality of service."""

from __future__ import annotations

import dataclasses
from typing import Any

from contact_reach_ros.errors import BagError
from contact_reach_ros.units import NANOSECONDS

INFINITE_NS = 2**63 - 1
"""A duration without limit, as ROS writes it, in ns."""


@dataclasses.dataclass(frozen=True)
class OfferedQos:
    """The quality of service that a publisher offers, in the words of a rosbag2 file (`keep_last`, ...)."""

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = "automatic"
    liveliness_lease_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def as_mapping(self) -> dict[str, Any]:
        """The profile as rosbag2 (version 9) spells it in YAML."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": _seconds_and_nanoseconds(self.deadline_ns),
            "lifespan": _seconds_and_nanoseconds(self.lifespan_ns),
            "liveliness": self.liveliness,
            "liveliness_lease_duration": _seconds_and_nanoseconds(self.liveliness_lease_ns),
            "avoid_ros_namespace_conventions": self.avoid_ros_namespace_conventions,
        }


@dataclasses.dataclass(frozen=True)
class Topic:
    """A topic of a bag: full name, type such as sensor_msgs/msg/JointState, and what its publishers offer."""

    name: str
    type: str
    offered_qos: tuple[OfferedQos, ...] = ()


def check_type_name(name: str) -> str:
    """Return `name` if it reads package/msg/Type.

    Raises
    ------
    BagError
        If it does not.
    """
    parts = name.split("/")
    if len(parts) != 3 or parts[1] != "msg" or not all(part.isidentifier() for part in parts):
        raise BagError(f"message type '{name}': expected package/msg/Type, as in sensor_msgs/msg/JointState")
    return name


def parse_topic(text: str) -> tuple[str, str | None]:
    """Read `name` or `name:package/msg/Type` into name and type, the latter None where it is left open.

    Raises
    ------
    BagError
        If the name is empty or the type is no type.
    """
    name, colon, type_name = text.strip().partition(":")
    if not name or any(character.isspace() for character in name):
        raise BagError(f"topic '{text}': expected a topic name, or name:package/msg/Type")
    return name, check_type_name(type_name) if colon else None


def _seconds_and_nanoseconds(duration_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(duration_ns, NANOSECONDS)
    return {"sec": seconds, "nsec": nanoseconds}
