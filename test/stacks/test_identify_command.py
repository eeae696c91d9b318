"""`contact-reach identify`: the goals of its motion, a running stack whose arm is not its model, and its bag."""

import re
import signal
import subprocess

import numpy as np
import pytest
import yaml
from arm_simulation import ARM, HOME
from contact_reach_command import contact_reach
from stack_helpers import environment, module, parameter_file, ready, running

from contact_reach_ros.bringup.excitation import check_clearance, goals
from contact_reach_ros.errors import InputError
from contact_reach_ros.presets import check_parameters
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.settings import parameters_in
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Plane
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

PAYLOAD = 0.5
SCENE = {"base": "free", "mismatch": {"inertia_set": "nominal", "payload": PAYLOAD, "friction_scale": 3.0}}


def obstacles(scene: str) -> Spheres:
    made = make_scene(read_scene(scene), ARM, 0)
    return obstacle_spheres(made, rest_positions(made))


def test_the_goals_are_reachable_above_the_floor_and_end_at_home():
    free = obstacles("free")
    check_clearance(ARM, HOME, free)
    for position, rotation in goals(ARM):
        check_goal(ARM, Target(position, rotation), free.environment, HOME)
    np.testing.assert_allclose(goals(ARM)[-1][0], goals(ARM)[0][0] - (0.0, 0.12, 0.05), atol=1e-12)


def test_an_obstacle_beside_the_arm_and_a_table_in_the_way_are_named():
    with pytest.raises(InputError, match=r"an obstacle would be .* m from the arm on the way to goal 1"):
        check_clearance(ARM, HOME, obstacles("ball"))
    table = Plane("table", (0.0, 0.0, 0.15))
    with pytest.raises(InputError, match=r"on the way to goal .* deep in the table"):
        check_clearance(ARM, HOME, Spheres.none((table,)))


def tried(env, *arguments, timeout=400):
    return subprocess.run([*module("cli"), *arguments], env=env, capture_output=True, text=True, timeout=timeout)


def test_a_bag_that_is_too_short_is_refused(tmp_path, capsys):
    assert contact_reach("identify", "--bag", "bags/sample", "--output", tmp_path / "none.yaml") == 2
    assert "expected at least 10 s" in capsys.readouterr().err
    assert not (tmp_path / "none.yaml").exists()


@pytest.mark.slow
def test_payload_of_the_running_stack(tmp_path):
    env = environment()
    scene, output, bag = tmp_path / "loaded.yaml", tmp_path / "up.txt", tmp_path / "bag"
    scene.write_text(yaml.safe_dump(SCENE))
    file = parameter_file(
        tmp_path / "own.yaml",
        planner={"goal_orientation": "pose", "speed_scale": 0.5},
        controller={"supervision": {"hold_limit": 1000.0}},
    )
    up = [*module("cli"), "up", "--lockstep", "--scene", str(scene), "--parameters", str(file), "--bag", str(bag)]
    with running(up, env, output) as process:
        ready(process, output)
        # Where the tests run in the background, they ignore it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupted = subprocess.Popen(
            [*module("cli"), "identify"], env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        for line in interrupted.stdout:
            if "goal 2" in line:
                interrupted.send_signal(signal.SIGINT)
                break
        rest = interrupted.stdout.read()
        assert interrupted.wait(30) == 130 and "the arm is held where it is" in rest, rest
        found = tried(env, "identify", "--output", str(tmp_path / "live.yaml"), "--parameters", str(file))
        assert found.returncode == 0, found.stdout + found.stderr
        assert tried(env, "stop").returncode == 0
        stopped = tried(env, "identify", "--output", str(tmp_path / "none.yaml"))
        assert stopped.returncode == 2 and "the arm is stopped" in stopped.stderr, stopped.stderr
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    mass = float(re.search(r"tool: ([\d.]+) ±", found.stdout)[1])
    ratio = float(re.search(r"falls to ([\d.]+) of before", found.stdout)[1])
    assert mass == pytest.approx(PAYLOAD, rel=0.05)
    assert ratio <= 1.0 / 3.0
    check_parameters(tmp_path / "live.yaml")
    assert parameters_in(tmp_path / "live.yaml", "planner")["goal_orientation"] == "pose"
    recorded = tried(env, "identify", "--bag", str(bag), "--output", str(tmp_path / "bag.yaml"))
    assert recorded.returncode == 0, recorded.stderr
    assert parameters_in(tmp_path / "bag.yaml", "observer")["tool.mass"] == pytest.approx(PAYLOAD, rel=0.05)
