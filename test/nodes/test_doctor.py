"""The doctor finds a good stack good, and names what is wrong with a bad one, and how to put it right.

Goals, stops and resets of the command line come last, in the same stack.
"""

import json
import os
import subprocess
import sys
from contextlib import contextmanager

import pytest
from stack_helpers import (
    SMALL_PLANNER,
    environment,
    module,
    parameter_file,
    processes_of_domain,
    running,
    wait_for,
)

from contact_reach_ros.arms import iiwa14
from contact_reach_ros.doctor import stack as checks
from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.messages import topics
from contact_reach_ros.ros import discovery

HELPER = """
import sys, time
from rclpy.node import Node
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.process import initialise
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.arms import iiwa14

initialise(["helper"])
{body}
"""

BAD_STACK = """
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


@contextmanager
def helper(body, env, output):
    """A node of somebody else in the graph."""
    with running([sys.executable, "-c", HELPER.format(body=body)], env, output) as process:
        wait_for(lambda: "up" in output.read_text(), 60, "the helper is up")
        yield process


def examine(env, folder, *arguments):
    """Run the doctor; returns the finished process, and its findings by name."""
    file = folder / "doctor.json"
    command = [*module("cli"), "doctor", "--json", str(file), *arguments]
    result = subprocess.run(command, env={**env, "COLUMNS": "200"}, capture_output=True, text=True, timeout=120)
    report = json.loads(file.read_text())
    assert report["exit_code"] == result.returncode, result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr
    return result, {check["name"]: check for check in report["checks"]}, report


def test_joints_in_another_order_and_a_second_commander_fail(tmp_path):
    env = environment()
    with helper(BAD_STACK, env, tmp_path / "helper.txt"):
        result, found, _ = examine(env, tmp_path)
    assert result.returncode == 1
    order = found["joint names and order"]
    assert order["verdict"] == "fail" and "lbr_A7, lbr_A6" in order["found"]
    assert ", ".join(iiwa14.ARM.joint_names) in order["fix"] and "effort_controller" in order["fix"]
    commands = found["effort_controller/commands"]
    assert commands["verdict"] == "fail" and "2 publishers" in commands["found"]
    assert "end /other_commander" in commands["fix"] and "end /other_commander" in result.stdout
    nodes = found["nodes"]
    assert nodes["verdict"] == "fail"
    assert "controller is silent, observer is missing, planner is missing" in nodes["found"]
    assert "ros2 run contact_reach_ros observer" in nodes["fix"]
    assert "start planner" in found["reference/pose"]["fix"]
    rate = found["driver rate"]
    assert rate["verdict"] == "fail" and "1000 Hz" in rate["fix"]
    gravity = found["gravity against torque"]
    assert gravity["verdict"] == "warn" and "not compared" in gravity["found"]


def test_without_a_stack_it_says_what_to_start(tmp_path):
    parameters = parameter_file(tmp_path / "wrong.yaml", planner={"perod": 0.1})
    result, found, _ = examine(environment(), tmp_path, "--parameters", str(parameters))
    assert found["nodes"]["verdict"] == "warn" and "no stack is running" in found["nodes"]["found"]
    assert "contact-reach up" in found["nodes"]["fix"]
    assert "joint_states" not in found
    assert result.returncode == 1
    assert found["parameters"]["verdict"] == "fail"
    assert "did you mean 'period'" in found["parameters"]["found"] and str(parameters) in found["parameters"]["found"]


@pytest.mark.parametrize(
    ("variables", "verdict", "words"),
    [
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, Verdict.WARN, "docs/security.md"),
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": "own.xml"}, Verdict.WARN, "own.xml"),
    ],
)
def test_discovery_of_the_environment(monkeypatch, variables, verdict, words):
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", *discovery.PROFILES, "ROS_LOCALHOST_ONLY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    finding = checks.discovery_in_use()
    assert finding.verdict is verdict and words in finding.found + finding.fix


def test_without_rclpy_it_says_so_and_goes_on(tmp_path):
    blocked = "import sys; sys.modules['rclpy'] = None; from contact_reach_ros.cli import main; main(sys.argv[1:])"
    file = tmp_path / "doctor.json"
    command = [sys.executable, "-c", blocked, "doctor", "--json", str(file)]
    result = subprocess.run(command, env=dict(os.environ), capture_output=True, text=True, timeout=60)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    found = {check["name"]: check for check in json.loads(file.read_text())["checks"]}
    assert found["rclpy"]["verdict"] == "fail" and "source /opt/ros" in found["rclpy"]["fix"]
    assert {"timer at 1 kHz", "parameters"} <= set(found)


# The stack takes whole cores: what does not need it comes before.


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """A lockstep stack at rest that is recorded, without a goal: its environment."""
    folder = tmp_path_factory.mktemp("stack")
    env, output = environment(), folder / "bringup.txt"
    parameters = parameter_file(folder / "small.yaml", planner=SMALL_PLANNER)
    command = [*module("cli"), "up", "--parameters", str(parameters), "--scene", "ball", "--lockstep"]
    with running([*command, "--bag", str(folder / "bag")], env, output) as process:
        wait_for(lambda: "all nodes are active" in output.read_text() or process.poll() is not None, 300, "stack up")
        assert process.poll() is None, output.read_text()
        # The brakes open after half a second of simulated time.
        yield env


def test_in_lockstep_nobody_keeps_others_from_running(stack):
    processes = processes_of_domain(stack["ROS_DOMAIN_ID"])
    for name in ("driver", "controller", "observer", "planner"):
        threads = [int(thread) for thread in os.listdir(f"/proc/{processes[name]}/task")]
        assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_OTHER}, name


def test_a_good_stack_passes(stack, tmp_path):
    result, found, report = examine(stack, tmp_path)
    expected = ["nodes", "safety state", "discovery", "parameters"]
    expected += ["joint names and order", "gravity against torque"]
    expected += [topic.name for topic in topics.ALL]
    others = {name: found[name] for name in expected if found[name]["verdict"] != "pass"}
    assert not others
    publisher, _, subscribers = found["effort_controller/commands"]["found"].partition(" → ")
    assert publisher == "controller" and sorted(subscribers.split(", ")) == ["driver", "recorder"]
    assert "controller: holding" in found["safety state"]["found"]
    assert sum(report["verdicts"].values()) == len(report["checks"])
    # A warning or failure without a way out is worth nothing.
    assert all(check["fix"] for check in report["checks"] if check["verdict"] != "pass")
    for name in expected:
        assert name in result.stdout


MANY = """
import json, sys
from contact_reach_ros.cli import main

for line in json.loads(sys.argv[1]):
    try:
        main(line.split())
    except SystemExit as ended:
        print(ended.code, flush=True)
"""


def command_lines(env, *lines):
    """Run command lines in one process; returns the last line that each printed, with its exit code."""
    command = [sys.executable, "-c", MANY, json.dumps(lines)]
    result = subprocess.run(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=200)
    printed = result.stdout.splitlines()
    ends = [index for index, line in enumerate(printed) if line.isdecimal()]
    assert len(ends) == len(lines), result.stdout
    return [(int(printed[index]), printed[index - 1]) for index in ends]


def test_without_a_stack_a_command_names_the_domain_and_what_to_start():
    env = environment()
    ((code, line),) = command_lines(env, "stop")
    assert code == 2 and f"ROS domain {env['ROS_DOMAIN_ID']}" in line and "contact-reach up" in line


def test_goals_stops_and_resets_from_the_command_line(stack):
    turned, settled, refused, faster, late, home, stopped, kept, released, again = command_lines(
        stack,
        "goto 0.51 0.025 0.145 --rpy 0 3.14 0",
        "goto 0.51 0.025 0.145 --wait",
        "goto 2.0 0.0 0.3",
        "speed 2",
        "home --wait --timeout 0.1",
        "home --wait",
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
    assert home[0] == 0 and home[1].startswith("settled: ")
    # By the controller, unless another was discovered a second before it.
    stops = {"controller": "compliant stop", "observer": "stopped", "driver": "brakes closed"}
    by, _, how = stopped[1].partition(": ")
    assert stopped[0] == 0 and how == stops[by]
    assert kept[0] == 1 and "stop service called" in kept[1] and "contact-reach reset" in kept[1]
    # The controller follows a stop of the observer, and does not know of one of the driver, whose brakes may follow.
    expected = "driver: released" if by == "driver" else "controller: holding"
    assert released[0] == 0 and expected in released[1], released
    assert again == (0, "nothing is stopped")
