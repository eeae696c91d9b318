"""The doctor finds a good stack good, and names what is wrong with a bad one, and how to put it right.

Goals, stops and resets of the command line come last, in the same stack.
"""

import json
import os
import subprocess
import sys

import pytest
from stack_helpers import (
    SMALL_PLANNER,
    command_lines,
    environment,
    module,
    parameter_file,
    processes_of_domain,
    ready,
    running,
    wait_for,
)

from contact_reach_ros.arms import iiwa14
from contact_reach_ros.doctor import stack as checks
from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.messages import topics
from contact_reach_ros.ros import discovery

BAD_STACK = """
import time
from rclpy.node import Node
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.process import initialise
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.arms import iiwa14

initialise(["helper"])
node = Node("arm")
commanders = [Node("controller"), Node("other_commander")]
for commander in commanders:
    commander.create_publisher(topics.COMMANDS.type, topics.COMMANDS.name, qos_profile(topics.COMMANDS.qos))
states = topics.JOINT_STATES
publisher = node.create_publisher(states.type, states.name, qos_profile(states.qos))
node.create_subscription(topics.COMMANDS.type, topics.COMMANDS.name, print, qos_profile(topics.NEWEST))
state = topics.JOINT_STATES.type(name=list(iiwa14.ARM.joint_names[::-1]), position=[0.0] * 7, velocity=[0.0] * 7)
print("up", flush=True)
while True:
    state.header.stamp = node.get_clock().now().to_msg()
    publisher.publish(state)
    time.sleep(0.01)
"""


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


def test_joints_in_another_order_and_a_second_commander_fail(tmp_path):
    env, output = environment(), tmp_path / "helper.txt"
    parameters = parameter_file(tmp_path / "wrong.yaml", planner={"perod": 0.1})
    with running([sys.executable, "-c", BAD_STACK], env, output):
        wait_for(lambda: "up" in output.read_text(), 60, "the bad stack is up")
        result, found = examine(env, tmp_path, "--parameters", str(parameters))
    assert result.returncode == 1 and "end /other_commander" in result.stdout
    for name, verdict, words, fix in (
        ("joint names and order", "fail", "lbr_A7, lbr_A6", ", ".join(iiwa14.ARM.joint_names)),
        ("effort_controller/commands", "fail", "2 publishers", "end /other_commander"),
        ("nodes", "fail", "controller is silent, observer is missing", "ros2 run contact_reach_ros observer"),
        ("reference/pose", "fail", "", "start planner"),
        ("driver rate", "fail", "", "1000 Hz"),
        ("gravity against torque", "warn", "not compared", ""),
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


def test_without_a_stack_a_command_names_the_domain_and_what_to_start(tmp_path):
    env = environment()
    ((code, line),) = command_lines(env, "stop")
    assert code == 2 and f"ROS domain {env['ROS_DOMAIN_ID']}" in line and "contact-reach up" in line
    _, found = examine(env, tmp_path)
    assert found["nodes"]["verdict"] == "warn" and "no stack is running" in found["nodes"]["found"]
    assert "contact-reach up" in found["nodes"]["fix"] and "joint_states" not in found


# The stack takes whole cores: what does not need it comes before.


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """A lockstep stack at rest that is recorded, without a goal: its environment."""
    folder = tmp_path_factory.mktemp("stack")
    env, output = environment(), folder / "bringup.txt"
    parameters = parameter_file(folder / "small.yaml", planner=SMALL_PLANNER)
    command = [*module("cli"), "up", "--parameters", str(parameters), "--scene", "ball", "--lockstep"]
    with running([*command, "--bag", str(folder / "bag")], env, output) as process:
        ready(process, output)
        yield env


def test_in_lockstep_nobody_keeps_others_from_running(stack):
    processes = processes_of_domain(stack["ROS_DOMAIN_ID"])
    for name in ("driver", "controller", "observer", "planner"):
        threads = [int(thread) for thread in os.listdir(f"/proc/{processes[name]}/task")]
        assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_OTHER}, name


def test_a_good_stack_passes(stack, tmp_path):
    result, found = examine(stack, tmp_path)
    expected = ["nodes", "safety state", "discovery", "parameters", "joint names and order", "gravity against torque"]
    expected += [topic.name for topic in topics.ALL]
    assert {name: found[name] for name in expected if found[name]["verdict"] != "pass"} == {}
    publisher, _, subscribers = found["effort_controller/commands"]["found"].partition(" → ")
    assert publisher == "controller" and sorted(subscribers.split(", ")) == ["driver", "recorder"]
    assert "controller: holding" in found["safety state"]["found"]
    assert all(name in result.stdout for name in expected)


def test_goals_stops_and_resets_from_the_command_line(stack):
    turned, settled, refused, faster, late, stopped, kept, released, again = command_lines(
        stack,
        "goto 0.51 0.025 0.145 --rpy 0 3.14 0",
        "goto 0.51 0.025 0.145 --wait",
        "goto 2.0 0.0 0.3",
        "speed 2",
        "home --wait --timeout 0.1",
        "stop",
        "goto 0.5 0.1 0.3",
        "reset",
        "reset",
    )
    assert refused[0] == 1 and "refused: goal: position" in refused[1]
    assert turned[0] == 2 and "goal_orientation = hold" in turned[1]
    assert settled[0] == 0 and settled[1].startswith("settled: ")
    assert faster[0] == 1 and "speed_scale" in faster[1]
    assert late[0] == 1 and late[1].startswith("not settled; ")
    # By the controller, unless another was discovered a second before it.
    stops = {"controller": "compliant stop", "observer": "stopped", "driver": "brakes closed"}
    by, _, how = stopped[1].partition(": ")
    assert stopped[0] == 0 and how == stops[by]
    assert kept[0] == 1 and "stop service called" in kept[1] and "contact-reach reset" in kept[1]
    # The controller follows a stop of the observer, and does not know of one of the driver, whose brakes may follow.
    expected = "driver: released" if by == "driver" else "controller: holding"
    assert released[0] == 0 and expected in released[1], released
    assert again == (0, "nothing is stopped")
