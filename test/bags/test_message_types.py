"""Definitions and hashes of types have to be those of the middleware, for what is written to be readable elsewhere."""

import pytest
import rclpy
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from contact_reach_ros.bags import message_types
from contact_reach_ros.bags.message_types import standard_definition
from contact_reach_ros.messages import topics


def test_hashes_are_those_of_the_middleware() -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = rclpy.create_node("hashes", context=context)
        for name, kind in {topic.type_name: topic.type for topic in topics.ALL}.items():
            topic = f"/{name.replace('/', '_')}"
            node.create_publisher(kind, topic, 1)
            (publisher,) = node.get_publishers_info_by_topic(topic)
            assert standard_definition(name)[1] == str(publisher.topic_type_hash), name
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


# Sequences with and without bounds, arrays, nested types, bytes and strings; none has a field of another package's own.
OTHERS = ("sensor_msgs/msg/JointState", "rcl_interfaces/msg/ParameterDescriptor", "rcl_interfaces/msg/Log")
OTHERS += ("sensor_msgs/msg/Imu", "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/ByteMultiArray")
OTHERS += ("shape_msgs/msg/SolidPrimitive",)


@pytest.mark.parametrize("name", OTHERS)
def test_a_type_that_is_only_installed_has_the_same_hash_and_fields(name, monkeypatch) -> None:
    expected = standard_definition(name)[1]
    own = get_typestore(Stores.EMPTY)
    monkeypatch.setattr(message_types, "_standard_types", lambda: own)
    text, type_hash = standard_definition(name)
    assert type_hash == expected
    # As a reader of the bag does.
    reader = get_typestore(Stores.EMPTY)
    reader.register(get_types_from_msg(text.decode(), name))
    assert reader.fielddefs[name][1] == own.fielddefs[name][1]
