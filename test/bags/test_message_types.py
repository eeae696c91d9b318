"""Definitions and hashes of types have to be those of the middleware, for what is written to be readable elsewhere."""

import os
from pathlib import Path

import pytest
import rclpy

from contact_reach_ros.bags.message_types import MessageTypes
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages import topics


def test_hashes_are_those_of_the_middleware() -> None:
    types = MessageTypes()
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = rclpy.create_node("hashes", context=context)
        for name, kind in {topic.type_name: topic.type for topic in topics.ALL}.items():
            topic = f"/{name.replace('/', '_')}"
            node.create_publisher(kind, topic, 1)
            (publisher,) = node.get_publishers_info_by_topic(topic)
            assert types.definition(name).type_hash == str(publisher.topic_type_hash), name
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


def test_types_of_a_sourced_workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = tmp_path / "share" / "arm_msgs" / "msg"
    messages.mkdir(parents=True)
    (messages / "ArmState.msg").write_text("std_msgs/Header header\nJoint[<=7] joints # measured\nJoint tool\n")
    (messages / "Joint.msg").write_text("float64[2] position\nstring<=20 name\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(["/nonexistent", str(tmp_path)]))
    definition = MessageTypes().definition("arm_msgs/msg/ArmState")
    assert b"MSG: arm_msgs/Joint" in definition.text
    assert b"MSG: builtin_interfaces/Time" in definition.text
    assert definition.type_hash.startswith("RIHS01_")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("arm_msgs/msg/Missing", r"share/arm_msgs/msg/Missing\.msg .* source the workspace"),
        ("sensor_msgs/JointState", "expected package/msg/Type"),
        ("a/msg/../b", "expected package/msg/Type"),
    ],
)
def test_unknown_type_is_refused(name: str, message: str) -> None:
    with pytest.raises(BagError, match=message):
        MessageTypes().definition(name)
