"""Definitions and hashes of types have to be those of the middleware, for what is written to be readable elsewhere."""

import importlib
import os
from pathlib import Path

import pytest
import rclpy

from contact_reach_ros.bags.message_types import MessageTypes
from contact_reach_ros.errors import BagError

STACK_TYPES = (
    "builtin_interfaces/msg/Time",
    "diagnostic_msgs/msg/DiagnosticArray",
    "diagnostic_msgs/msg/DiagnosticStatus",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "nav_msgs/msg/Path",
    "rosgraph_msgs/msg/Clock",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/String",
    "trajectory_msgs/msg/JointTrajectory",
    "trajectory_msgs/msg/MultiDOFJointTrajectory",
    "visualization_msgs/msg/MarkerArray",
)


def test_hashes_are_those_of_the_middleware() -> None:
    types = MessageTypes()
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = rclpy.create_node("hashes", context=context)
        for name in STACK_TYPES:
            package, _, type_name = name.split("/")
            message_class = getattr(importlib.import_module(f"{package}.msg"), type_name)
            topic = f"/{package}/{type_name}"
            node.create_publisher(message_class, topic, 1)
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


def test_unknown_type_says_where_it_was_looked_for() -> None:
    with pytest.raises(BagError, match=r"share/arm_msgs/msg/Missing\.msg .* source the workspace"):
        MessageTypes().definition("arm_msgs/msg/Missing")


@pytest.mark.parametrize("name", ["", "sensor_msgs/JointState", "a/msg/../b"])
def test_malformed_name_is_refused(name: str) -> None:
    with pytest.raises(BagError, match="expected package/msg/Type"):
        MessageTypes().definition(name)
