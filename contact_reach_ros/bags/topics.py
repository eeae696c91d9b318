"""Topics of a bag: their names, types and quality of service."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import yaml

from contact_reach_ros.errors import BagError
from contact_reach_ros.units import NANOSECONDS

ROS2MSG = "ros2msg"
"""Language of .msg files, the only one of definitions that is read and written here."""
CDR = "cdr"
"""Serialisation of ROS 2 messages."""

INFINITE_NS = 2**63 - 1
"""ROS's value for a duration without limit, ns."""


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
        """Return the profile under the names that rosbag2 (version 9) uses in YAML."""
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

    @classmethod
    def from_mapping(cls, profile: Mapping[str, Any]) -> OfferedQos:
        """Read a profile from a bag; older versions of rosbag2 wrote numbers in place of words.

        Raises `BagError` if the mapping is no such profile.
        """
        try:
            return cls(
                history=_word("history", profile),
                depth=int(profile["depth"]),
                reliability=_word("reliability", profile),
                durability=_word("durability", profile),
                deadline_ns=_nanoseconds(profile["deadline"]),
                lifespan_ns=_nanoseconds(profile["lifespan"]),
                liveliness=_word("liveliness", profile),
                liveliness_lease_ns=_nanoseconds(profile["liveliness_lease_duration"]),
                avoid_ros_namespace_conventions=bool(profile["avoid_ros_namespace_conventions"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise BagError(
                f"quality of service {profile!r}: expected the profile of a rosbag2 file ({error})"
            ) from error


_NUMBERED: Mapping[str, Mapping[Any, str]] = {
    "history": {0: "system_default", 1: "keep_last", 2: "keep_all", 3: "unknown"},
    "reliability": {0: "system_default", 1: "reliable", 2: "best_effort", 3: "unknown", 4: "best_available"},
    "durability": {0: "system_default", 1: "transient_local", 2: "volatile", 3: "unknown", 4: "best_available"},
    "liveliness": {0: "system_default", 1: "automatic", 3: "manual_by_topic", 4: "unknown", 5: "best_available"},
}
"""Meaning of rmw's numbers, which files up to version 8 have."""


def read_offered_qos(text: str) -> tuple[OfferedQos, ...]:
    """Read the profiles that an mcap channel holds as YAML; empty if there are none.

    Raises `BagError` if the text is something else.
    """
    try:
        profiles = yaml.safe_load(text) or []
    except yaml.YAMLError as error:
        raise BagError(f"quality of service: not valid YAML: {error}") from error
    if not isinstance(profiles, list):
        raise BagError(f"quality of service {profiles!r}: expected a list of profiles")
    return tuple(OfferedQos.from_mapping(profile) for profile in profiles)


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


def parse_topic(text: str) -> tuple[str, str | None]:
    """Split `name` or `name:package/msg/Type` into name and type; the type is None if not given.

    Raises `BagError` if the name is empty or the type is malformed.
    """
    name, colon, type_name = text.strip().partition(":")
    if not name or any(character.isspace() for character in name):
        raise BagError(f"topic '{text}': expected a topic name, or name:package/msg/Type")
    return name, check_type_name(type_name) if colon else None


def _seconds_and_nanoseconds(duration_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(duration_ns, NANOSECONDS)
    return {"sec": seconds, "nsec": nanoseconds}


def _nanoseconds(duration: Mapping[str, int]) -> int:
    return duration["sec"] * NANOSECONDS + duration["nsec"]


def _word(field: str, profile: Mapping[str, Any]) -> str:
    return _NUMBERED[field].get(profile[field], str(profile[field]))
