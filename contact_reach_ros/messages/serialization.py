"""Between message objects and the bytes that the middleware carries.

ROS's own serialisation comes with rclpy, which is imported only when a whole message has to be converted: the readers
and writers of this room can be imported without it.
"""

from __future__ import annotations

from typing import Any

from contact_reach_ros.errors import InputError


def encode(message: Any) -> bytes:
    """Serialise a message; up to eight bytes of padding may follow it."""
    from rclpy.serialization import serialize_message

    data: bytes = serialize_message(message)
    return data


def decode(data: bytes, message_type: type, topic: str) -> Any:
    """Deserialise a message.

    Raises `InputError` if the bytes are no message of that type; the topic is named.
    """
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.serialization import deserialize_message

    try:
        return deserialize_message(data, message_type)
    except rclpy_implementation.RMWError as error:
        name = message_type.__name__
        raise InputError(
            f"{topic}: {len(data)} bytes that are no {name}; expected a serialised {name} ({error})"
        ) from error
