"""Definitions and hashes of types have to be those of the middleware, for what is written to be readable elsewhere."""

import rclpy

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
