"""Demo and bring-up notice a stack in their ROS domain, and leave it alone."""

import os
import subprocess
from pathlib import Path

import pytest
import rclpy
from contact_reach_ros.ros.node_processes import node_processes
from sensor_msgs.msg import JointState
from stack_helpers import environment, module, running, wait_for

from contact_reach_ros.bringup import bringup
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.ros.running import running as running_parts


@pytest.fixture
def node():
    rclpy.init()
    yield rclpy.create_node("demo")
    rclpy.shutdown()


@pytest.fixture
def other():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield lambda name, namespace="": rclpy.create_node(name, context=context, namespace=namespace)
    rclpy.shutdown(context=context)


def test_nodes_that_are_to_be_started_are_found(node, other):
    _robot = other("planner")
    wait_for(lambda: running_parts(node, ["planner", "controller"]) == ["/planner"], 10, "the planner is found")
    assert running_parts(node, ["planner"], own=["planner"]) == []
    assert running_parts(node, ["driver", "controller"]) == []


def test_those_in_another_namespace_are_another_stack(node, other):
    _other = other("planner", "left")
    robot = other("robot", "left")
    _publisher = robot.create_publisher(JointState, "joint_states", qos_profile(topics.JOINT_STATES.qos))
    seen = ("planner", "/left")
    wait_for(lambda: seen in node.get_node_names_and_namespaces(), 10, "the planner is discovered")
    wait_for(lambda: node.count_publishers("/left/joint_states"), 10, "the driver is discovered")
    assert running_parts(node, ["planner", "driver"]) == []


def test_a_robots_driver_of_any_name_is_found_where_one_is_to_be_started(node, other):
    robot = other("robot")
    _publisher = robot.create_publisher(JointState, "joint_states", qos_profile(topics.JOINT_STATES.qos))
    found = ["/robot (on joint_states)"]
    wait_for(lambda: running_parts(node, ["driver", "controller"]) == found, 10, "the robot's driver is found")
    assert running_parts(node, ["controller"]) == []


def test_beside_a_stack_nothing_is_started(tmp_path):
    """A process of the package is found without discovery."""
    env = environment()
    domain = int(env["ROS_DOMAIN_ID"])
    with running(module("nodes.observer"), env, tmp_path / "observer.txt"):
        for command in ([*module("cli"), "demo"], module("bringup.bringup")):
            result = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True, timeout=60)
            assert result.returncode == 2
            assert f"already running in ROS domain {domain}: /observer" in result.stderr
            assert f"export ROS_DOMAIN_ID={domain + 1}" in result.stderr
            assert "summary" not in result.stdout + result.stderr
    assert os.listdir(tmp_path) == ["observer.txt"]


def test_a_file_whose_parameters_bring_up_would_not_pass_on_is_refused(tmp_path, capsys):
    file = tmp_path / "own.yaml"
    file.write_text("bringup: {ros__parameters: {seed: 3}}\nplanner: {ros__parameters: {period: 0.1}}\n")
    assert bringup.run_bringup(["bringup", "--ros-args", "--params-file", str(file)]) == 2
    assert f"for planner; give the nodes' file as -p parameters:={file}" in capsys.readouterr().err


def test_wrong_parameters_are_named_before_anything_starts(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("plannner: {ros__parameters: {period: 0.1}}\n")
    command = [*module("cli"), "demo", "--parameters", str(file)]
    result = subprocess.run(command, env=environment(), cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == f"contact-reach: {file}: unknown node 'plannner'; did you mean 'planner'?\n"
    assert os.listdir(tmp_path) == ["own.yaml"]


def fake_process(proc: Path, number: int, arguments: list[str], domain: str) -> None:
    folder = proc / str(number)
    folder.mkdir()
    (folder / "cmdline").write_bytes("\0".join([*arguments, ""]).encode())
    (folder / "environ").write_bytes(f"HOME=/\0ROS_DOMAIN_ID={domain}\0".encode())


def test_processes_are_those_of_the_node_and_the_domain(tmp_path):
    fake_process(tmp_path, 1, ["python", "-m", "contact_reach_ros.nodes.planner", "--ros-args"], "7")
    fake_process(tmp_path, 2, ["python", "-m", "contact_reach_ros.nodes.planner"], "8")
    fake_process(tmp_path, 3, ["/usr/bin/python3", "/ws/lib/contact_reach_ros/controller"], "7")
    fake_process(tmp_path, 4, ["vim", "planner.py", "planner"], "7")
    fake_process(tmp_path, 5, ["python", "-m", "contact_reach_ros.bringup.bringup"], "7")
    fake_process(tmp_path, 6, ["/venv/bin/python", "/venv/bin/viewer"], "7")
    fake_process(tmp_path, 7, ["python", "-m", "contact_reach_ros.cli", "demo"], "7")
    user = (tmp_path / "1").stat().st_uid
    assert node_processes("7", tmp_path, user) == {1: "planner", 3: "controller", 5: "bringup", 6: "viewer"}
    assert node_processes("8", tmp_path, user) == {2: "planner"}
    assert node_processes("7", tmp_path, user + 1) == {}


def test_processes_of_one_namespace_can_be_chosen(tmp_path):
    fake_process(tmp_path, 1, ["python", "-m", "contact_reach_ros.nodes.planner", "--ros-args"], "7")
    fake_process(tmp_path, 2, ["python", "-m", "contact_reach_ros.nodes.driver", "-r", "__ns:=/left"], "7")
    assert node_processes("7", tmp_path, namespace="/") == {1: "planner"}
    assert node_processes("7", tmp_path, namespace="/left") == {2: "driver"}
    assert len(node_processes("7", tmp_path)) == 2
