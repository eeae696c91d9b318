"""The main job, end to end and in lockstep: stack up, goal on the topic, arm reaches it, bag and report written."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import rclpy
from contact_reach_command import contact_reach
from mcap.reader import make_reader
from stack_helpers import (
    SMALL_PLANNER,
    environment,
    module,
    parameter_file,
    processes_of_domain,
    ready,
    ros,
    running,
    wait_for,
)

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bringup import demo as demo_module
from contact_reach_ros.bringup.demo import DemoOptions, run_demo
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.goal_state import read_goal_state
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.planning.goal_progress import GoalPhase
from contact_reach_ros.ros.inbox import qos_profile

UNHEARD = {topics.ADAPTER_COMMANDS, topics.SHADOW_COMMANDS}
"""Topics that the demo's stack does not publish."""
TIME = re.compile(r"from the goal after ([0-9.]+) s")
"""Time since the goal was sent in the demo's progress, s."""


def command(folder):
    parameters = parameter_file(folder / "small.yaml", planner=SMALL_PLANNER)
    files = ["--parameters", str(parameters), "--output", str(folder / "bags"), "--json", str(folder / "r.json")]
    return [*module("cli"), "demo", "--lockstep", "--scene", "ball", "--seed", "1", *files]


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """The demo's output, its report and its bag."""
    folder = tmp_path_factory.mktemp("ball")
    result = subprocess.run(command(folder), env=environment(), capture_output=True, text=True, timeout=600)
    assert result.returncode == 0 and "Traceback" not in result.stdout + result.stderr, result.stdout + result.stderr
    report = json.loads((folder / "r.json").read_text())
    return result.stdout, report, Path(report["bag"])


def stand_still_when_heard(name, domain):
    """Stop a node's process for three seconds at its first promise."""
    wait_for(lambda: name in processes_of_domain(domain), 240, f"{name} is started")
    process, heard, topic = processes_of_domain(domain)[name], set(), topics.LOCKSTEP_HORIZON
    with ros(domain=domain):
        look = rclpy.create_node("look")
        look.create_subscription(
            topic.type, topic.name, lambda message: heard.add(message.frame_id), qos_profile(topic.qos)
        )
        while name not in heard and name in processes_of_domain(domain):
            rclpy.spin_once(look, timeout_sec=0.1)
        os.kill(process, signal.SIGSTOP)
    time.sleep(3.0)
    os.kill(process, signal.SIGCONT)


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """The bag of the same demo beside a busy program, which is killed on its way; no process is left.

    Its controller stands still for a while as soon as it takes part.
    """
    folder, env = tmp_path_factory.mktemp("killed"), environment()
    output = folder / "printed.txt"
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        try:
            with running(command(folder), env, output) as process:
                stand_still_when_heard("controller", env["ROS_DOMAIN_ID"])
                ready(process, output, "from the goal after")
                wait_for(lambda: float(TIME.findall(output.read_text())[-1]) >= 0.5, 60, "the arm is on its way")
                process.kill()
        finally:
            busy.kill()
    wait_for(lambda: not processes_of_domain(env["ROS_DOMAIN_ID"]), 20, "all processes of the stack have ended")
    (bag,) = (path for path in (folder / "bags").iterdir() if path.is_dir())
    return bag


def test_the_goal_is_reached_and_reported(ball):
    printed, report, bag = ball
    assert report["good"] and report["verdict"] == "goal reached" and "goal reached" in printed
    numbers = {name: metric["value"] for name, metric in report["metrics"].items()}
    assert numbers["distance at the end"] <= 10.0
    assert 0.0 <= numbers["largest contact force"] < 30.0
    assert 0.0 < numbers["largest external torque"] < 30.0
    assert numbers["ticks"] > 1000 * numbers["time to the goal"] > 0.0 and numbers["ticks missed"] == 0.0
    assert numbers["round trip p50"] > 0.0 and numbers["plan takes p50"] > 0.0
    assert 0.0 < numbers["greatest plan age"] < 300.0
    assert bag.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_the_bag_opens_with_the_mcap_library_and_lacks_no_topic_and_no_tick(ball):
    _, _, bag = ball
    (file,) = bag.glob("*.mcap")
    counts, types = Counter(), {}
    with file.open("rb") as stream:
        for schema, channel, _ in make_reader(stream).iter_messages():
            counts[channel.topic] += 1
            types[channel.topic] = schema.name
    own = {f"/{topic.name}": topic.type_name for topic in topics.ALL if topic not in UNHEARD}
    assert types == own | {"/rosout": "rcl_interfaces/msg/Log"}
    assert counts["/goal_pose"] == counts["/robot_description"] == 1
    assert counts["/reference/pose"] == counts["/reference/posture"]
    # The stop at the end withdraws the plan in force; the planner may be ended before it hears of the stop.
    plans = counts["/plan/statistics"]
    assert counts["/reference/pose"] - plans in (0, 1) and plans > 20
    # In lockstep each state comes once, and none is missing.
    states = BagReader(bag).messages("/joint_states")
    stamps = sorted(nanoseconds(state.header.stamp) for state in states)
    assert len(stamps) > 1000 and set(np.diff(stamps)) == {1_000_000}


def test_the_bag_tells_what_happened_to_the_goal(ball):
    _, report, bag = ball
    reader = BagReader(bag)
    read = [read_goal_state(message) for message in reader.messages("/goal/state")]
    (sent,) = (nanoseconds(goal.header.stamp) for goal in reader.messages("/goal_pose"))
    phases = list(dict.fromkeys(state.phase for _, state in read))
    assert phases[:4] == [GoalPhase.ACCEPTED, GoalPhase.RUNNING, GoalPhase.REACHED, GoalPhase.SETTLED]
    assert {stamp for stamp, _ in read} == {sent}
    settled = next(state for _, state in read if state.phase is GoalPhase.SETTLED)
    assert settled.distance <= 0.01 and settled.elapsed == pytest.approx(
        report["metrics"]["time to the goal"]["value"], abs=0.02
    )


def test_every_tick_of_the_bag_can_be_executed_again_and_a_plan_solved_again(ball, tmp_path):
    """Also the first tick: the recorder hears everybody before time begins."""
    _, report, bag = ball
    assert contact_reach("reexecute", bag, "--json", tmp_path / "ticks.json") == 0
    again = json.loads((tmp_path / "ticks.json").read_text())
    for node in ("controller", "observer"):
        found = again[node]
        assert found["identical"] and found["compared"] == found["outputs"] >= report["metrics"]["ticks"]["value"] - 100
    assert contact_reach("reexecute", bag, "--plan", "6", "--json", tmp_path / "plan.json") == 0
    plan = json.loads((tmp_path / "plan.json").read_text())["plan"]
    assert plan["number"] == 6 and plan["equal"]
    assert plan["now"]["cost"] == pytest.approx(float(plan["recorded"]["cost"]), rel=1e-4)


SAME = ("joint_states", "effort_controller/commands", "external_torque", "reference/pose", "reference/posture")


def recorded(bag):
    """Messages of a bag with all digits, by topic.

    The bytes themselves may differ: the middleware leaves the padding of what it serializes as it finds it.
    """
    reader = BagReader(bag)
    with np.printoptions(floatmode="unique", threshold=sys.maxsize):
        return {f"/{name}": list(map(repr, reader.messages(f"/{name}"))) for name in SAME}


@pytest.mark.slow
def test_a_run_beside_a_busy_program_is_the_same_to_the_last_digit(ball, killed):
    """Joint states, commands, external torques and plans; in the end nodes do not wait for those that are gone."""
    first = recorded(ball[2])
    for name, data in recorded(killed).items():
        same = data[: len(data) * 9 // 10]
        assert len(same) > 10 and same == first[name][: len(same)], name


@pytest.mark.parametrize(
    ("options", "word"), [(["--goal", "2.0", "0.0", "0.5"], "2.0"), (["--seed", "-3"], "seed = -3")]
)
def test_a_goal_out_of_reach_or_a_seed_that_is_none_is_refused_before_anything_starts(options, word, capsys):
    assert contact_reach("demo", *options) == 2
    assert word in capsys.readouterr().err


@pytest.mark.parametrize(
    ("code", "missed", "options", "again"),
    [
        (1, 0.07, {}, True),
        (1, 0.01, {}, False),
        (0, 0.07, {}, False),
        (1, 0.07, {"lockstep": True}, False),
        (1, 0.07, {"view": True}, False),
    ],
    ids=["not reached", "not reached in time", "reached", "lockstep", "page"],
)
def test_what_a_slow_machine_fails_in_real_time_is_repeated_in_lockstep(
    code, missed, options, again, monkeypatch, capsys
):
    found = []

    def run(options):
        found.append(options.lockstep)
        return (code, missed) if len(found) == 1 else (0, 0.0)

    monkeypatch.setattr(demo_module, "_run", run)
    assert run_demo(DemoOptions(**options)) == (0 if again else code)
    assert found == [options.get("lockstep", False), *[True] * again]
    assert ("7% of the ticks were missed" in capsys.readouterr().out) == again
