"""The stack on the conventions of real drivers, through the adapter: goals are reached, and silence is harmless."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from contact_reach_command import contact_reach
from stack_helpers import (
    PATIENT_PLANNER,
    command_lines,
    environment,
    module,
    processes_of_domain,
    ready,
    running,
    speeds_until,
    wait_for,
)

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import arm_of_bag, read_signals
from contact_reach_ros.messages.safety_state import ERROR
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import parameters_in

THERE, AWAY = "goto 0.51 0.025 0.145 --wait", "goto 0.45 -0.45 0.35"
"""The second goal is half a metre from home: the arm is on its way for some seconds."""
PAGE, STAGES = ((Path(__file__).parents[2] / "docs" / name).read_text() for name in ("adapter.md", "real_robot.md"))
KUKA, FRANKA = "lbr generation=later", "franka"
SET_UPS = [
    ("effort", 1000),
    ("effort FORWARD=true", 200),
    (FRANKA, 1000),
    ("lbr generation=2024", 500),
    (KUKA, 500),
    (KUKA, 1000),
]
"""Arguments of the stand-in, and the rate of its states, Hz."""
ROBOTS = {"effort": {"robot": "iiwa14", "state_rate": 500.0}, "franka": {}, "lbr": {}}
"""What docs/real_robot.md has the reader add for the stand-ins, for all nodes."""
BRAKES = {"effort": "", "lbr": "the connection is closed", "franka": "no controller is active"}
"""Why each driver closes the brakes after a stop of the adapter; the first one does not."""
MOVES, RESTS = 0.15, 0.05
"""Speed of a joint that moves, and of one at rest, rad/s."""
ATTEMPTS = 3
"""On a machine that stands still for a while the arm is rightly stopped before it has moved: that shows nothing."""


def parameters_of(kind, path):
    """The parameter file that bring-up takes for a kind, with a planner that is patient on a busy machine."""
    content = yaml.safe_load(config_file(f"{'default' if kind == 'effort' else kind}.yaml").read_text())
    planner = content.setdefault("planner", {}).setdefault("ros__parameters", {})
    planner.update(PATIENT_PLANNER, planning={**planner.get("planning", {}), **PATIENT_PLANNER["planning"]})
    path.write_text(yaml.safe_dump(content))
    return str(path)


def command_of_page(kind):
    """The command with which docs/adapter.md starts the stack for a kind of driver."""
    lines = (line.partition("#")[0].split() for line in PAGE.splitlines() if "contact_reach_ros bringup" in line)
    (words,) = (line for line in lines if f"adapter:={kind}" in line)
    assert words[:4] == ["ros2", "run", "contact_reach_ros", "bringup"]
    return [*module("bringup.bringup"), *words[4:]]


def driver_of(set_up, rate):
    """The command of the stand-in."""
    command = [sys.executable, str(Path(__file__).with_name("standins.py")), *set_up.split()]
    arm = ["-p", "robot:=fr3"] if set_up == FRANKA else []
    return [*command, "--ros-args", "-p", f"state_rate:={rate}.0", *arm]


@contextmanager
def stack(set_up, rate, lockstep, env, folder, scene="ball", change=lambda up, driver: None):
    """A driver of that kind, and the stack on it; yields what the driver prints, its command, and its process.

    `change` alters both commands.
    """
    kind = set_up.split()[0]
    output, drivers = folder / "up.txt", folder / "driver.txt"
    driver = [*driver_of(set_up, rate), "-p", f"scene:={scene}"]
    up = [*command_of_page(kind), "-p", f"state_rate:={rate}.0", "-p", f"bag:={folder / 'bag'}"]
    if lockstep:
        driver += ["-p", "use_sim_time:=true"]
        up += ["-p", "lockstep:=true"]
    else:
        up += ["-p", f"parameters:={parameters_of(kind, folder / 'parameters.yaml')}"]
    change(up, driver)
    with running(up, env, output) as process:
        ready(process, output)
        with running(driver, env, drivers) as process:
            ready(process, drivers, "active")
            yield drivers, driver, process


@pytest.mark.slow
@pytest.mark.parametrize(("set_up", "rate"), SET_UPS)
def test_two_goals_settle_by_the_command_of_the_page(set_up, rate, packages, tmp_path, capsys):
    env = {**environment(), **packages}
    with stack(set_up, rate, True, env, tmp_path):
        ended = command_lines(env, THERE, f"{AWAY} --wait")
    assert [(code, said[:9]) for code, said in ended] == [(0, "settled: ")] * 2
    assert all(float(said.partition(" mm")[0].rpartition(" ")[2]) <= 1.0 for _, said in ended), ended
    bag = BagReader(tmp_path / "bag")
    said = list(bag.messages("/safety_state"))
    assert not any(each.level == ERROR or "contact" in each.message for each in said if each.name == "observer")
    signals = read_signals(bag, arm_of_bag(bag))
    assert len(signals.command.time) > 1000 and np.isfinite(signals.command.values).all()
    assert contact_reach("reexecute", tmp_path / "bag") == 0 and capsys.readouterr().out.count("identical") == 2


def with_slow_states(up, driver):
    up += ["-r", "joint_states:=joint_states"]


def in_another_namespace(up, driver):
    driver += ["-r", "__ns:=/left"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("set_up", "change", "words"),
    [
        ("lbr generation=later stiffness=200.0", None, "JointImpedanceControlMode(0, 0, 0, 0, 0, 0, 0)"),
        ("lbr generation=2024 open_loop=true", None, "set open_loop: false"),
        (KUKA, in_another_namespace, "there is /left/lbr/state: set lbr.driver"),
        (FRANKA, with_slow_states, "franka/joint_states"),
        ("effort RIVAL=joint_trajectory_controller", None, "--deactivate joint_trajectory_controller"),
    ],
)
def test_a_wrong_set_up_is_named_before_the_arm_moves(set_up, change, words, packages, tmp_path):
    env, rate = {**environment(), **packages}, 1000 if set_up == FRANKA else 500
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        # Nothing but a driver that is heard can run in lockstep.
        with stack(set_up, rate, change is None, env, folder, "free", change or (lambda up, driver: None)):
            ((code, said),) = command_lines(env, THERE)
        if not re.search("silent for|blind: for", said):
            break
    assert code and words in said, said
    bag = BagReader(folder / "bag")
    arm = arm_of_bag(bag)
    model = RobotModel(arm)
    states = [dict(zip(state.name, state.position, strict=True)) for state in bag.messages("/joint_states")]
    tips = [model.tip_pose(np.array([state[name] for name in arm.joint_names]))[0] for state in states]
    assert all(np.linalg.norm(tip - tips[0]) < 0.005 for tip in tips)


def stand_still_in_motion(kind, env, folder):
    """Have the controller stand still when the arm is on its way; what the driver said until the arm was at rest.

    None if the arm did not move.
    """
    folder.mkdir()
    domain = env["ROS_DOMAIN_ID"]
    with stack(kind, 500, False, env, folder, "free") as (drivers, _, _):
        controller = processes_of_domain(domain)["controller"]
        ((code, _),) = command_lines(env, AWAY)
        if code or not speeds_until(domain, lambda speeds: speeds[-1] > MOVES):
            return None
        os.kill(controller, signal.SIGSTOP)
        try:
            if BRAKES[kind]:
                wait_for(lambda: "brakes closed: " in drivers.read_text(), 60, "the brakes are closed")
            # KUKA's driver reports nothing any more once its connection is closed.
            if kind != "lbr":
                assert speeds_until(domain, lambda speeds: len(speeds) > 200 and max(speeds[-200:]) < RESTS)
        finally:
            os.kill(controller, signal.SIGCONT)
        return drivers.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("kind", BRAKES)
def test_in_real_time_a_controller_that_stands_still_in_motion_leaves_the_arm_at_rest(kind, packages, tmp_path):
    """Slow: where the driver itself stands still for 75 ms, as on a busy machine, the arm is stopped before."""
    env = {**environment(), **packages}
    attempts = (stand_still_in_motion(kind, env, tmp_path / str(attempt)) for attempt in range(ATTEMPTS))
    said = next(filter(None, attempts), None)
    assert said is not None, "the arm did not move"
    assert BRAKES[kind] in said and ("brakes closed: " in said) == bool(BRAKES[kind])
    bag = BagReader(max(tmp_path.glob("*/bag")))
    said = [each for each in bag.messages("/safety_state") if each.name == "adapter"]
    assert next(each.message for each in said if each.level == ERROR).startswith("no command for")
    speeds = [np.abs(state.velocity).max() for state in bag.messages("/joint_states")]
    assert max(speeds) > MOVES
    # KUKA's driver reports nothing any more once its connection is closed.
    assert kind == "lbr" or max(speeds[-100:]) < RESTS


def vanish_in_motion(kind, env, folder):
    """Kill the driver when the arm is on its way, and start it again; how a goal ends then, and one after a reset.

    None if the arm did not move before; it must not move in between.
    """
    folder.mkdir()
    domain = env["ROS_DOMAIN_ID"]
    with stack(kind, 500, False, env, folder, "free") as (_, driver, process):
        ((code, _),) = command_lines(env, AWAY)
        if code or not speeds_until(domain, lambda speeds: speeds[-1] > MOVES):
            return None
        process.kill()
        process.wait()
        output = folder / "again.txt"
        with running(driver, env, output) as process:
            ready(process, output, "active")
            assert speeds_until(domain, lambda speeds: len(speeds) > 500)
            assert not speeds_until(domain, lambda speeds: speeds[-1] > RESTS, 3.0)
            ((code, said),) = command_lines(env, AWAY)
            # The middleware forgets a killed process after 20 s; until then there are two drivers.
            wait_for(lambda: command_lines(env, "reset")[0][0] == 0, 60, "the stop is released")
            ((again, _),) = command_lines(env, AWAY)
            return code, said, again


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["effort", FRANKA])
def test_a_driver_that_vanishes_and_comes_back_moves_nothing_before_a_reset(kind, packages, tmp_path):
    env = {**environment(), **packages}
    attempts = (vanish_in_motion(kind, env, tmp_path / str(attempt)) for attempt in range(ATTEMPTS))
    code, said, again = next(filter(None, attempts), None) or pytest.fail("the arm did not move")
    assert code and "the arm is stopped: " in said and "nothing on joint_states for" in said, said
    assert not again


def doctor(env, folder, *options):
    """Findings of the doctor by name."""
    file = folder / "doctor.json"
    command = [*module("cli"), "doctor", "--json", str(file), *options]
    subprocess.run(command, env=env, capture_output=True, timeout=120)
    return {check["name"]: check for check in json.loads(file.read_text())["checks"]}


def own_file(kind, folder, **planner):
    """my_arm.yaml of docs/real_robot.md."""
    content = yaml.safe_load(config_file(f"{'default' if kind == 'effort' else kind}.yaml").read_text())
    content.setdefault("/**", {}).setdefault("ros__parameters", {}).update(ROBOTS[kind])
    content.setdefault("planner", {}).setdefault("ros__parameters", {}).update(planner)
    (folder / "my_arm.yaml").write_text(yaml.safe_dump(content))


def stages(kind):
    """The commands of docs/real_robot.md by the heading of their stage, words after contact-reach."""
    found = {}
    for section in re.split(r"^## ", STAGES, flags=re.MULTILINE)[1:]:
        blocks = "".join(re.findall(r"^```\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)).replace("\\\n", " ")
        lines = [shlex.split(line.replace("$KIND", kind)) for line in blocks.splitlines()]
        found[section[0]] = [words[1:] for words in lines if words and words[0] == "contact-reach"]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("set_up", "rate", "said"),
    [
        ("effort", 500, "in the order lbr_A3, lbr_A1"),
        (FRANKA, 1000, "in the order fr3_joint3, fr3_joint1"),
        (KUKA, 500, "lbr_fri_ros2_stack later than 2024; KUKA's stiffness, which must be 0"),
    ],
)
def test_the_stages_of_the_page_from_listening_to_a_slow_motion(set_up, rate, said, packages, tmp_path, monkeypatch):
    kind, folder, output = set_up.split()[0], tmp_path, tmp_path / "driver.txt"
    env, driver = {**environment(), **packages}, driver_of(set_up, rate)
    own_file(kind, folder, require_obstacles=False)
    monkeypatch.chdir(folder)
    page = stages(kind)
    with running(driver, env, output) as process:
        ready(process, output, "active")
        ((_, *options),) = (words for words in page["3"] if words[0] == "doctor")
        found = doctor(env, folder, *options)
        assert said in found["driver"]["found"] and "driver" in found["commands"]["found"]
        # On a busy machine states come irregularly.
        names = ("driver", "commands", "joint names and order", "clocks", "parameters")
        assert [found[name]["verdict"] for name in names] == ["pass"] * len(names), found
    for stage, goals in (("4", []), ("5", []), ("7", [words for words in page["7"] if words[0] != "up"])):
        with lockstep_stage(page[stage], driver, env, folder) as (bag, text):
            if goals:
                ended = command_lines(env, *map(shlex.join, goals))
                assert [code for code, _ in ended] == [0] * len(goals), ended
            else:
                assert speeds_until(env["ROS_DOMAIN_ID"], lambda speeds: len(speeds) > 100)
            if stage == "5":
                found = doctor(env, folder, *options)
                failed = [name for name, check in found.items() if check["verdict"] == "fail"]
                assert failed in ([], ["timer at 1 kHz"]), [found[name] for name in failed]
        topics = BagReader(bag).topics
        assert ("/shadow/commands" in topics) == (stage == "4") != ("/adapter/commands" in topics)
        assert "stopped the arm" not in text.read_text()


@contextmanager
def lockstep_stage(commands, driver, env, folder, scene="free", number=0):
    """One of a stage's stacks, on a driver in lockstep; yields its bag and what it prints."""
    up = [words for words in commands if words[0] == "up"][number]
    bag = folder / up[up.index("--bag") + 1]
    text, output = folder / f"{bag.name}.txt", folder / "driver.txt"
    with running([*module("cli"), *up, "--lockstep"], env, text) as process:
        ready(process, text)
        with running([*driver, "-p", "use_sim_time:=true", "-p", f"scene:={scene}"], env, output) as process:
            ready(process, output, "active")
            yield bag, text


@pytest.mark.slow
@pytest.mark.parametrize(("set_up", "rate"), [("effort", 500), (FRANKA, 1000), (KUKA, 500)])
def test_the_stage_of_identification_finds_what_the_flange_carries(set_up, rate, packages, tmp_path, monkeypatch):
    kind, folder, scene = set_up.split()[0], tmp_path, tmp_path / "loaded.yaml"
    payload = 0.5
    scene.write_text(yaml.safe_dump({"base": "free", "mismatch": {"inertia_set": "nominal", "payload": payload}}))
    env, driver, page = {**environment(), **packages}, driver_of(set_up, rate), stages(kind)["6"]
    own_file(kind, folder, require_obstacles=False)
    monkeypatch.chdir(folder)
    with lockstep_stage(page, driver, env, folder, scene):
        (identify,) = (words for words in page if words[0] == "identify")
        ((code, said),) = command_lines(env, shlex.join(identify), timeout=1200.0)
    assert code == 0, said
    os.replace("identified.yaml", "my_arm.yaml")
    assert parameters_in(Path("my_arm.yaml"), "observer").get("tool.mass", 0.0) == pytest.approx(payload, abs=0.03)
    with lockstep_stage(page, driver, env, folder, scene, number=1) as (_, text):
        assert speeds_until(env["ROS_DOMAIN_ID"], lambda speeds: len(speeds) > 100)
    assert "stopped the arm" not in text.read_text()


@pytest.mark.slow
@pytest.mark.parametrize(("set_up", "rate"), [("effort", 500), (FRANKA, 1000), (KUKA, 500)])
def test_the_stages_of_the_first_touch_and_of_full_speed(set_up, rate, packages, tmp_path, monkeypatch):
    kind, page = set_up.split()[0], stages(set_up.split()[0])
    env, driver = {**environment(), **packages}, driver_of(set_up, rate)
    own_file(kind, tmp_path)
    monkeypatch.chdir(tmp_path)
    scene, centers = tmp_path / "sponge.yaml", re.findall(r"(\[[^]]*, 0\.4\])", STAGES)
    center = centers[kind == FRANKA]
    scene.write_text(
        yaml.safe_dump({"base": "ball", "target": {"reach": 0.0}, "ball": {"center": yaml.safe_load(center)}})
    )
    goals = [words for words in (*page["8"], *page["9"]) if words[0] != "up"]
    with lockstep_stage(page["8"], driver, env, tmp_path, scene) as (folder, text):
        ended = command_lines(env, *map(shlex.join, goals), timeout=1200.0)
    assert [code for code, _ in ended] == [0] * len(goals), ended
    assert "stopped the arm" not in text.read_text()
    bag = BagReader(folder)
    touched = [max(map(abs, message.effort), default=0.0) for message in bag.messages("/sim/contacts")]
    assert max(touched) > 1.0
    assert not any(each.level == ERROR for each in bag.messages("/safety_state"))
