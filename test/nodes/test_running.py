"""Demo and bring-up notice a stack in their ROS domain, and leave it alone."""

import subprocess

import pytest
import rclpy
from sensor_msgs.msg import JointState
from stack_helpers import environment, module, ready, ros, running, wait_for

from contact_reach_ros.bringup import bringup
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.graph import running as running_parts
from contact_reach_ros.ros.inbox import qos_profile


def another(name, namespace="", publishes=False):
    """A node of somebody else, perhaps with joint states."""
    made = rclpy.create_node(name, namespace=namespace)
    if publishes:
        made.create_publisher(JointState, "joint_states", qos_profile(topics.JOINT_STATES.qos))
    return made


@pytest.fixture
def node():
    with ros():
        yield rclpy.create_node("demo")


def test_nodes_that_are_to_be_started_are_found(node):
    _planner = another("planner")
    wait_for(lambda: running_parts(node, ["planner", "controller"]) == ["/planner"], 10, "the planner is found")
    assert running_parts(node, ["planner"], own=["planner"]) == []
    assert running_parts(node, ["driver", "controller"]) == []


def test_those_in_another_namespace_are_another_stack(node):
    _others = another("planner", "left"), another("robot", "left", publishes=True)
    seen = ("planner", "/left")
    wait_for(lambda: seen in node.get_node_names_and_namespaces(), 10, "the planner is discovered")
    wait_for(lambda: node.count_publishers("/left/joint_states"), 10, "the driver is discovered")
    assert running_parts(node, ["planner", "driver"]) == []


def test_a_robots_driver_of_any_name_is_found_where_one_is_to_be_started(node):
    _robot = another("robot", publishes=True)
    found = ["/robot (on joint_states)"]
    wait_for(lambda: running_parts(node, ["driver", "controller"]) == found, 10, "the robot's driver is found")
    assert running_parts(node, ["controller"]) == []


def test_beside_a_stack_nothing_is_started(tmp_path):
    env = environment()
    domain = int(env["ROS_DOMAIN_ID"])
    with running(module("nodes.observer"), env, tmp_path / "observer.txt") as observer:
        # Before that there may be no node yet.
        ready(observer, tmp_path / "observer.txt", "active")
        for command in ([*module("cli"), "demo"], module("bringup.bringup")):
            result = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True, timeout=60)
            assert result.returncode == 2
            assert f"already running in ROS domain {domain}: /observer" in result.stderr
            assert "export ROS_DOMAIN_ID=" in result.stderr
            assert "summary" not in result.stdout + result.stderr
            # On a busy machine the observer is discovered late, and what had been started is ended again.
            assert observer.poll() is None


def test_a_file_whose_parameters_bring_up_would_not_pass_on_is_refused(tmp_path, capsys):
    file = tmp_path / "own.yaml"
    file.write_text("bringup: {ros__parameters: {view: true}}\nplanner: {ros__parameters: {period: 0.1}}\n")
    assert bringup.run_bringup(["bringup", "--ros-args", "--params-file", str(file)]) == 2
    assert f"for planner; give the nodes' file as -p parameters:={file}" in capsys.readouterr().err
