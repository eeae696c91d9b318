"""The format of bags: topics, their types and quality of service, and where rosbag2 keeps the metadata."""

from __future__ import annotations

import dataclasses
from typing import Any

ROS2MSG = "ros2msg"
"""Language of the definitions of types: that of .msg files."""
LOST = "messages_lost"
"""Key of a bag's custom data for the number of lost messages; with a topic's name appended, those of that topic."""
CDR = "cdr"
"""Serialisation of ROS 2 messages."""
MCAP_NAME, MCAP_KEY = "rosbag2", "serialized_metadata"
"""Record and key under which rosbag2 keeps a copy of the metadata inside the mcap file."""

_UNLIMITED = {"sec": 9223372036, "nsec": 854775807}
"""ROS's value for a duration without limit, as rosbag2 writes it."""


@dataclasses.dataclass(frozen=True)
class RecordedTopic:
    """A topic of a bag.

    Attributes
    ----------
    name :
        Full name.
    type :
        Such as sensor_msgs/msg/JointState.
    depth :
        Number of messages that its publishers kept.
    latched :
        Whether late subscribers received them.
    encoding :
        How its messages are serialised.
    message_count :
        Number of its messages in a bag that was read.
    """

    name: str
    type: str
    depth: int = 10
    latched: bool = False
    encoding: str = CDR
    message_count: int = 0


def written_qos(topic: RecordedTopic) -> list[dict[str, Any]]:
    """The quality of service of a topic as rosbag2 writes it: as one reliable publisher offers it."""
    return [
        {
            "history": "keep_last",
            "depth": topic.depth,
            "reliability": "reliable",
            "durability": "transient_local" if topic.latched else "volatile",
            "deadline": _UNLIMITED,
            "lifespan": _UNLIMITED,
            "liveliness": "automatic",
            "liveliness_lease_duration": _UNLIMITED,
            "avoid_ros_namespace_conventions": False,
        }
    ]
