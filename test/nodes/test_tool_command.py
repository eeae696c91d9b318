"""`contact-reach tool` on a running stack, and the bag of it."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
from stack_helpers import SMALL_PLANNER, environment, module, parameter_file, running, wait_for

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages.intake import Taken
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.loops import reexecute_controller, reexecute_observer

pytestmark = pytest.mark.slow

TOOL = {"mass": 1.0, "center": [0.03, 0.0, 0.06], "flange_to_tip": [0.0, 0.0, 0.15, 0.0, 0.3, 0.0]}
ARM = load_arm()
LOADED = ARM.with_tool(Tool(**TOOL))
GOAL = "0.45 0.1 0.2"
COMPILED_S = 240

LINES = """
import json, sys
from contact_reach_ros.cli import main

for line in json.loads(sys.argv[1]):
    try:
        main(line.split())
    except SystemExit as ended:
        print(ended.code, flush=True)
"""


def command(env, *lines):
    """The output of command lines, the exit code after each."""
    arguments = [sys.executable, "-c", LINES, json.dumps(lines)]
    return subprocess.run(
        arguments, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300
    ).stdout


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """What the commands printed, and the bag."""
    folder = tmp_path_factory.mktemp("tool")
    env, output, bag = environment(), folder / "bringup.txt", folder / "bag"
    tool = parameter_file(folder / "tool.yaml", **{"/**": {"tool": TOOL}})
    parameters = parameter_file(folder / "small.yaml", planner=SMALL_PLANNER)
    up = [*module("cli"), "up", "--parameters", str(parameters), "--scene", "free", "--lockstep", "--bag", str(bag)]
    said = {}
    with running(up, env, output) as process:
        wait_for(lambda: "all nodes are active" in output.read_text() or process.poll() is not None, 300, "stack up")
        assert process.poll() is None, output.read_text()
        said["first"] = command(env, f"goto {GOAL}", f"tool {tool} --attach")
        said["settled"] = command(env, f"goto {GOAL} --wait", f"tool {tool} --attach")
        give_up = time.monotonic() + COMPILED_S
        while "being compiled" in said.setdefault("compiling", command(env, f"goto {GOAL} --wait")):
            said["refused meanwhile"] = said.pop("compiling")
            assert time.monotonic() < give_up
        said["stack"] = output.read_text()
    return said, bag


def test_on_the_way_to_a_goal_it_is_refused_and_nothing_changes(recorded):
    said, _ = recorded
    assert "planner: there is a goal" in said["first"]
    assert said["first"].endswith("the planner refuses the tool; nothing has changed\n1\n")


def test_with_the_goal_reached_all_nodes_get_it_in_turn(recorded):
    said, _ = recorded
    answers = [line for line in said["settled"].splitlines() if ": has the tool" in line]
    assert answers == [f"{node}: has the tool" for node in ("planner", "driver", "controller", "observer")], said
    assert said["settled"].endswith("0\n"), said


def test_the_planner_takes_goals_of_the_tip_once_it_is_ready(recorded):
    said, bag = recorded
    assert said["compiling"].splitlines()[-2].startswith("settled: ")
    inputs = RecordedInputs(BagReader(bag))
    assert [arm.digest for arm in inputs.arms["planner"]] == [ARM.digest, LOADED.digest]
    last = [row.sent_ns for row in inputs.intakes["planner"] if row.what is Taken.JOINT_STATES][-1]
    tip = RobotModel(LOADED).tip_pose(inputs.state(last).q)[0]
    assert np.linalg.norm(tip - np.array(GOAL.split(), float)) < 0.011


def test_nothing_stops_and_no_torque_jumps(recorded):
    _, bag = recorded
    inputs = RecordedInputs(BagReader(bag))
    rows = list(inputs.intakes["controller"])
    (at,) = [row for row in rows if row.what is Taken.TOOL]
    by_number = inputs.by_output("effort_controller/commands")
    torques = inputs.columns["effort_controller/commands"].values
    around = torques[by_number[at.output] - 200 : by_number[at.output] + 500]
    assert np.abs(np.diff(around, axis=0)).max() < 4.1
    for node in ("controller", "observer", "driver"):
        # But the call with which the stack ends.
        reasons = inputs.safety_reasons(node)
        assert all(reason.startswith(("stop service called", "no command for")) for reason in reasons), (node, reasons)


def test_the_bag_reexecutes_through_the_change(recorded):
    _, bag = recorded
    inputs = RecordedInputs(BagReader(bag))
    for reexecute in (reexecute_controller, reexecute_observer):
        found = reexecute(inputs)
        assert found.first_difference is None, found.first_difference
        assert found.compared > 1000
