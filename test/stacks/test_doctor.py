"""The doctor names what is wrong with a bad stack, and how to put it right; test_lockstep_stack.py has a good one."""

import json
import os
import subprocess
import sys
import threading

import pytest
import rclpy
from arm_simulation import ARM
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from stack_helpers import command_lines, environment, module, parameter_file, ros

from contact_reach_ros.doctor import stack as checks
from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.messages import topics
from contact_reach_ros.ros import discovery
from contact_reach_ros.ros.inbox import qos_profile


@pytest.fixture
def bad_stack():
    """Environment of a domain with joint states in another order at a tenth of the rate, and two commanders."""
    env, ended = environment(), threading.Event()

    def publish(node, topic):
        return node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))

    with ros(domain=env["ROS_DOMAIN_ID"]):
        arm, *commanders = (rclpy.create_node(name) for name in ("arm", "controller", "other_commander"))
        mover = rclpy.create_node("effort_controller")
        mover.declare_parameter("joints", list(ARM.joint_names[::-1]))
        mover.declare_parameter("command_timeout", 0.0)
        arm.create_subscription(topics.COMMANDS.type, topics.COMMANDS.name, print, qos_profile(topics.NEWEST))
        states = publish(arm, topics.JOINT_STATES)
        commands = [publish(commander, topics.COMMANDS) for commander in commanders]

        executor = SingleThreadedExecutor()
        executor.add_node(mover)

        def show():
            state = JointState(name=ARM.joint_names[::-1], position=[0.0] * 7, velocity=[0.0] * 7)
            while not ended.wait(0.01):
                state.header.stamp = arm.get_clock().now().to_msg()
                states.publish(state)
                executor.spin_once(0.0)

        thread = threading.Thread(target=show)
        thread.start()
        yield env
        ended.set()
        thread.join()
        del commands


def examine(env, folder, *arguments, program=()):
    """Run the doctor; returns the finished process, and its findings by name."""
    file = folder / "doctor.json"
    command = [*(program or module("cli")), "doctor", "--json", str(file), *arguments]
    result = subprocess.run(command, env={**env, "COLUMNS": "200"}, capture_output=True, text=True, timeout=120)
    report = json.loads(file.read_text())
    assert report["exit_code"] == result.returncode, result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr
    # A warning or failure without a way out is worth nothing.
    assert all(check["fix"] for check in report["checks"] if check["verdict"] != "pass")
    return result, {check["name"]: check for check in report["checks"]}


@pytest.mark.slow
def test_joints_in_another_order_and_a_second_commander_fail(bad_stack, tmp_path):
    parameters = parameter_file(tmp_path / "wrong.yaml", planner={"perod": 0.1})
    result, found = examine(bad_stack, tmp_path, "--parameters", str(parameters))
    assert result.returncode == 1 and "end /other_commander" in result.stdout
    for name, verdict, words, fix in (
        ("joint names and order", "fail", "lbr_A7, lbr_A6", ", ".join(ARM.joint_names)),
        ("effort_controller/commands", "fail", "2 publishers", "end /other_commander"),
        ("nodes", "fail", "controller is silent, observer is missing", "ros2 run contact_reach_ros observer"),
        ("reference/pose", "fail", "", "start planner"),
        ("driver rate", "fail", "", "1000 Hz"),
        ("gravity against torque", "warn", "not compared", ""),
        ("without commands", "warn", "command_timeout of effort_controller is off", "command_timeout: 0.1"),
        ("parameters", "fail", "did you mean 'period'", ""),
    ):
        assert found[name]["verdict"] == verdict
        assert words in found[name]["found"] and fix in found[name]["fix"], name


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "docs/security.md"),
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": "own.xml"}, "own.xml"),
    ],
)
def test_discovery_beyond_this_host_is_a_warning(monkeypatch, variables, words):
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", *discovery.PROFILES, "ROS_LOCALHOST_ONLY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    finding = checks.discovery_in_use()
    assert finding.verdict is Verdict.WARN and words in finding.found + finding.fix


def test_without_rclpy_it_says_so_and_goes_on(tmp_path):
    blocked = "import sys; sys.modules['rclpy'] = None; from contact_reach_ros.cli import main; main(sys.argv[1:])"
    result, found = examine(dict(os.environ), tmp_path, program=[sys.executable, "-c", blocked])
    assert result.returncode == 1
    assert found["rclpy"]["verdict"] == "fail" and "source /opt/ros" in found["rclpy"]["fix"]
    assert {"timer at 1 kHz", "parameters"} <= set(found)


def test_without_a_stack_a_command_names_the_domain_and_what_to_start():
    env = environment()
    ((code, line),) = command_lines(env, "stop")
    assert code == 2 and f"ROS domain {env['ROS_DOMAIN_ID']}" in line and "contact-reach up" in line
