"""The arm from the robot's own description, which other nodes publish."""

import dataclasses
from contextlib import contextmanager

import pytest
import rclpy
import yaml
from arm_simulation import ARM
from rclpy.qos import DurabilityPolicy, QoSProfile
from stack_helpers import parameter_file, ros, wait_for
from std_msgs.msg import String

from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.processes import processes, resolved, stack_arm
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros import description
from contact_reach_ros.ros.parameters import check_arguments
from contact_reach_ros.ros.process import described, initialise, with_description
from contact_reach_ros.settings import ROBOT

DESCRIPTION = topics.ROBOT_DESCRIPTION.name
NAMES = [name.replace("lbr", "left_lbr") for name in ARM.joint_names]
URDF = build_urdf(ARM).replace("lbr_", "left_lbr_").replace('effort="320.0"', 'effort="300.0"')
"""As a driver with a prefix publishes it; another limit shows that the numbers are its own."""
HANGING = build_urdf(dataclasses.replace(ARM, gravity=(0.0, 0.0, 9.81)))


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    # Only a machine that is busy with other tests needs it.
    monkeypatch.setattr(description, "_PATIENCE_S", 30.0)


@contextmanager
def published(*texts, topic=f"/{DESCRIPTION}", latched=True):
    """Each text is published by a node of its own, once, in this domain."""
    context = rclpy.Context()
    rclpy.init(context=context)
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    qos = QoSProfile(depth=1, durability=durability)
    nodes = []
    for number, text in enumerate(texts):
        nodes.append(rclpy.create_node(f"robot_state_publisher_{number}", context=context))
        nodes[-1].create_publisher(String, topic, qos).publish(String(data=text))
    try:
        yield
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.shutdown(context=context)


def test_names_limits_and_inertias_are_those_of_the_description():
    with published(URDF, URDF):
        arm = load_arm(described(DESCRIPTION, "test"))
    assert list(arm.joint_names) == NAMES
    assert [joint.torque_limit for joint in arm.joints[:4]] == [300.0, 300.0, 176.0, 176.0]
    masses = [inertia.mass for inertia in arm.inertias("nominal")]
    assert masses == pytest.approx([inertia.mass for inertia in ARM.inertias("nominal")])
    assert arm.gravity == pytest.approx(ARM.gravity)


def test_options_are_in_a_yaml_file_and_the_mounting_in_the_description(tmp_path):
    options = tmp_path / "mine.yaml"
    options.write_text(yaml.safe_dump({"urdf": DESCRIPTION, "base": ARM.base_frame, "name": "mine"}))
    with published(HANGING):
        arm = load_arm(described(str(options), "test"))
    assert (arm.name, arm.base_frame) == ("mine", ARM.base_frame)
    assert arm.gravity == pytest.approx((0.0, 0.0, 9.81))
    assert described("iiwa7", "test") == "iiwa7"


def test_the_same_description_is_the_same_file_whose_options_count():
    with published(URDF):
        found = {described(DESCRIPTION, "test") for _ in range(2)}
    assert len(found) == 1


@pytest.mark.parametrize(
    ("texts", "latched", "message"),
    [
        ((), True, rf"nothing came on /{DESCRIPTION} .*\(nobody publishes\).* start the driver or robot_state_pub"),
        ((URDF,), False, r"\(published by /robot_state_publisher_0, but not latched \(transient local\)\)"),
        ((URDF, HANGING), True, r"/robot_state_publisher_0, /robot_state_publisher_1 publish different descriptions"),
        (("<robot name='r'/>",), True, rf"the description on /{DESCRIPTION}: .* a YAML file with the key urdf"),
    ],
)
def test_what_is_wrong_is_said_with_the_topic(texts, latched, message, monkeypatch):
    if not (texts and latched):
        monkeypatch.setattr(description, "_PATIENCE_S", 3.0)
    with published(*texts, latched=latched), pytest.raises(SettingsError, match=message):
        described(DESCRIPTION, "test")


def test_a_node_that_is_started_alone_has_the_arm_of_its_namespace(monkeypatch):
    given = ["observer", "--ros-args", "-r", "__ns:=/left", "-p", f"robot:={DESCRIPTION}"]
    with published(URDF, topic=f"/left/{DESCRIPTION}"):
        arguments = with_description(given, "observer")
    check_arguments(arguments, ObserverNode.NAME, ObserverNode.SECTIONS)
    initialise(arguments)
    monkeypatch.setattr(ObserverNode, "ARGUMENTS", arguments)
    try:
        assert list(ObserverNode().arm.joint_names) == NAMES
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize("in_file", [False, True])
def test_bringup_gives_every_node_the_file(tmp_path, in_file):
    file = parameter_file(tmp_path / "own.yaml", **({"/**": {"robot": DESCRIPTION}} if in_file else {"planner": {}}))
    asked = BringupOptions(parameters=str(file), robot="" if in_file else DESCRIPTION, view=True, driver=False)
    with published(URDF):
        options = resolved(asked, "bringup")
    assert list(stack_arm(options).joint_names) == NAMES
    assert {process.parameters[ROBOT.name] for process in processes(options)} == {options.robot}


def test_the_planner_publishes_what_nobody_else_does():
    with ros():
        name = f"/{DESCRIPTION}"
        planner, other = PlannerNode(), rclpy.create_node("other")
        planner.describe_robot()
        wait_for(lambda: other.count_publishers(name) == 1, 10, "the planner publishes it")
        planner.describe_robot()
        assert planner.count_publishers(name) == 1
    with ros():
        planner, other = PlannerNode(), rclpy.create_node("other")
        other.create_publisher(String, name, 1)
        wait_for(lambda: planner.count_publishers(name), 10, "it is published")
        planner.describe_robot()
        assert planner.count_publishers(name) == 1
