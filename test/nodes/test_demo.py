"""The main job, end to end and in lockstep: stack up, goal on the topic, arm reaches it, bag and report written."""

import itertools
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from stack_helpers import SMALL_PLANNER, environment, module, parameter_file

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages.goal_state import read_goal_state
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.planning.goal_progress import GoalPhase

TYPES = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/effort_controller/commands": "std_msgs/msg/Float64MultiArray",
    "/goal_pose": "geometry_msgs/msg/PoseStamped",
    "/goal/state": "diagnostic_msgs/msg/DiagnosticStatus",
    "/reference/pose": "trajectory_msgs/msg/MultiDOFJointTrajectory",
    "/reference/posture": "trajectory_msgs/msg/JointTrajectory",
    "/obstacles": "visualization_msgs/msg/MarkerArray",
    "/external_torque": "sensor_msgs/msg/JointState",
    "/external_wrench": "geometry_msgs/msg/WrenchStamped",
    "/safety_state": "diagnostic_msgs/msg/DiagnosticStatus",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/plan/path": "nav_msgs/msg/Path",
    "/plan/markers": "visualization_msgs/msg/MarkerArray",
    "/sim/contacts": "sensor_msgs/msg/JointState",
    "/robot_description": "std_msgs/msg/String",
    "/clock": "rosgraph_msgs/msg/Clock",
    "/lockstep/horizon": "std_msgs/msg/Header",
    "/plan/statistics": "diagnostic_msgs/msg/DiagnosticArray",
    "/plan/request": "std_msgs/msg/Float64MultiArray",
    "/settings": "diagnostic_msgs/msg/DiagnosticStatus",
    "/intake/controller": "std_msgs/msg/Int64MultiArray",
    "/intake/observer": "std_msgs/msg/Int64MultiArray",
}

GOAL_TICK = 502
"""Time at which the goal is sent, in joint states: the first look, every 0.1 s, at which the brakes are open."""


def demo(folder, *arguments):
    parameters = parameter_file(folder / "small.yaml", planner=SMALL_PLANNER)
    command = [*module("cli"), "demo", "--lockstep", "--output", str(folder / "bags"), "--json", str(folder / "r.json")]
    return subprocess.run(
        [*command, "--parameters", str(parameters), *arguments],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=600,
    )


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    result = demo(folder, "--scene", "ball", "--seed", "1")
    assert result.returncode == 0, result.stdout + result.stderr
    return result, json.loads((folder / "r.json").read_text())


def test_the_goal_is_reached_and_reported(ball):
    result, report = ball
    assert report["reached"] and report["safety_events"] == []
    assert report["final_error_m"] <= 0.01
    assert 0.1 < report["distance_m"] < 0.8
    # Nothing moves faster than the limit that the bound on the step and the gains set.
    assert report["time_ratio"] >= 1.0 - 1e-3 and report["duration_s"] > 0.0
    assert 0.0 <= report["max_contact_force_N"] < 30.0
    assert 0.0 < report["max_external_torque_Nm"] < 30.0
    assert report["ticks"] > 1000 * report["duration_s"]
    assert set(report["round_trip_us"]) == {"p50", "p99", "p999"}
    assert set(report["plan_ms"]) == {"p50", "p95", "max"} and report["plan_ms"]["p50"] > 0.0
    assert 0.0 < report["plan_age_ms_max"] < 300.0
    assert "reached" in result.stdout and "Traceback" not in result.stdout + result.stderr
    assert "plotly" in Path(report["report"]).read_text()


def test_the_bag_opens_with_the_mcap_library(ball):
    _, report = ball
    (file,) = Path(report["bag"]).glob("*.mcap")
    counts, types, stamps = Counter(), {}, []
    with file.open("rb") as stream:
        for schema, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            counts[channel.topic] += 1
            types[channel.topic] = schema.name
            if channel.topic == "/joint_states":
                stamps.append((message.header.stamp.sec, message.header.stamp.nanosec))
    assert types == TYPES
    assert counts["/goal_pose"] == 1 and counts["/robot_description"] == 1
    assert counts["/reference/pose"] == counts["/reference/posture"] == counts["/plan/path"] > 20
    # In lockstep every state is answered, and none is missing.
    assert len(stamps) > 1000
    distinct = sorted(set(stamps))
    steps = [
        (later[0] - earlier[0]) * 1_000_000_000 + later[1] - earlier[1]
        for earlier, later in itertools.pairwise(distinct)
    ]
    assert set(steps) == {1_000_000}


def test_the_bag_tells_what_happened_to_the_goal(ball):
    _, report = ball
    reader = BagReader(Path(report["bag"]))
    read = [read_goal_state(item.message) for item in reader.messages(["/goal/state"])]
    (sent,) = (nanoseconds(item.message.header.stamp) for item in reader.messages(["/goal_pose"]))
    phases = list(dict.fromkeys(state.phase for _, state in read))
    assert phases[:3] == [GoalPhase.ACCEPTED, GoalPhase.RUNNING, GoalPhase.REACHED]
    assert {stamp for stamp, _ in read} == {sent}
    reached = next(state for _, state in read if state.phase is GoalPhase.REACHED)
    assert reached.distance <= 0.01 and reached.elapsed == pytest.approx(report["duration_s"], abs=0.02)


def reexecuted(bag: str, folder: Path, *arguments: str) -> dict:
    result = subprocess.run(
        [*module("cli"), "reexecute", bag, *arguments, "--json", str(folder / "again.json")],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return json.loads((folder / "again.json").read_text())


def test_every_tick_of_the_bag_can_be_executed_again(ball, tmp_path):
    """Also the first one: the recorder hears everybody before time begins."""
    _, report = ball
    again = reexecuted(report["bag"], tmp_path)
    for node in ("controller", "observer"):
        found = again[node]
        assert found["identical"] and found["compared"] == found["outputs"] >= report["ticks"] - 100
        assert found["largest_difference_Nm"] == 0.0


def test_a_plan_of_the_bag_is_solved_again(ball, tmp_path):
    _, report = ball
    again = reexecuted(report["bag"], tmp_path, "--plan", "6")["plan"]
    assert again["number"] == 6 and again["equal"]
    assert again["now"]["cost"] == pytest.approx(float(again["recorded"]["cost"]), rel=1e-4)


SAME = ("joint_states", "effort_controller/commands", "external_torque", "reference/pose", "reference/posture")


def recorded(bag: str, ticks: int) -> dict[str, list[str]]:
    """Messages of a bag with all digits, by topic: those of the first joint states, each of which is answered once.

    The bytes themselves may differ: the middleware leaves the padding of what it serializes as it finds it.
    """
    found: dict[str, list[str]] = {f"/{name}": [] for name in SAME}
    with np.printoptions(floatmode="unique", threshold=sys.maxsize):
        for message in BagReader(Path(bag)).messages(found):
            found[message.topic].append(repr(message.message))
    # The first one is repeated until everybody is there.
    found["/joint_states"] = list(dict.fromkeys(found["/joint_states"]))
    plans = (ticks - GOAL_TICK) // 30
    return {name: data[: plans if name.startswith("/reference") else ticks] for name, data in found.items()}


def test_a_run_beside_a_busy_program_is_the_same_to_the_last_digit(ball, tmp_path):
    """Joint states, commands, external torques and plans, from the first on until half a second after the goal."""
    _, report = ball
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        try:
            demo(tmp_path, "--scene", "ball", "--seed", "1", "--timeout", "0.5")
        finally:
            busy.kill()
    again = json.loads((tmp_path / "r.json").read_text())
    ticks = again["ticks"]
    assert abs(ticks - (GOAL_TICK + 500)) <= 1
    first, second = recorded(report["bag"], ticks), recorded(again["bag"], ticks)
    for name, data in first.items():
        assert len(data) > 10 and data == second[name], name


def test_a_goal_out_of_reach_is_refused_before_anything_starts(tmp_path):
    result = demo(tmp_path, "--goal", "2.0", "0.0", "0.5")
    assert result.returncode == 2
    assert "2.0" in result.stderr and "Traceback" not in result.stderr
