"""Whatever process dies, the arm is left at rest, one message names the reason, and no process stays behind."""

import os
import re
import signal

import numpy as np
import pytest
from stack_helpers import PATIENT_PLANNER, environment, module, parameter_file, processes_of_domain, running, wait_for

from contact_reach_ros.arms import load_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import read_signals

REST = 0.1
"""Joint speed that counts as rest, sensor noise included, rad/s."""
ATTEMPTS = 3
"""On a machine that stands still for a while the arm is rightly stopped before it has moved: that shows nothing."""


def kill_in_motion(victim, env, folder):
    """Start a demo in real time, kill a node when the arm is on its way; exit code, and all that was printed.

    None if the arm did not move.
    """
    folder.mkdir()
    parameters, output = parameter_file(folder / "small.yaml", planner=PATIENT_PLANNER), folder / "output.txt"
    files = ["--output", str(folder), "--parameters", str(parameters)]
    with running([*module("cli"), "demo", "--scene", "ball", "--seed", "1", *files], env, output) as process:
        wait_for(lambda: moved(output.read_text()) or process.poll() is not None, 300, "the arm moves")
        if process.poll() is not None:
            return None
        os.kill(processes_of_domain(env["ROS_DOMAIN_ID"])[victim], signal.SIGKILL)
        return process.wait(120), output.read_text()


def moved(text):
    """Whether the demo's progress shows the arm on its way."""
    distances = [float(number) for number in re.findall(r"([0-9.]+) mm and .* from the goal", text)]
    return bool(distances) and distances[-1] < distances[0] - 10.0


def assert_nothing_left(env):
    wait_for(lambda: not processes_of_domain(env["ROS_DOMAIN_ID"]), 20, "all processes of the stack have ended")


OTHERS = ("observer", "planner", "driver", "recorder")


@pytest.mark.parametrize("victim", ["controller", *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_a_killed_node_ends_the_stack_with_the_arm_at_rest(victim, tmp_path):
    env = environment()
    attempts = (kill_in_motion(victim, env, tmp_path / str(attempt)) for attempt in range(ATTEMPTS))
    code, text = next(filter(None, attempts), (None, "the arm did not move"))
    assert code == 1, text
    assert text.count(f"{victim} ended (killed by SIGKILL)") == 1 and "Traceback" not in text
    assert_nothing_left(env)
    bag = max(path for path in tmp_path.glob("*/demo_*") if path.is_dir())
    speeds = np.abs(read_signals(BagReader(bag), load_arm()).velocity.values).max(axis=1)
    assert speeds.max() > REST, "the arm never moved: the test shows nothing"
    if victim not in ("driver", "recorder"):
        # The last tenth of a second of the bag; without a driver there is no arm, without a recorder no bag.
        assert speeds[-100:].max() < REST


@pytest.mark.slow
def test_bringup_names_the_node_that_cannot_start(tmp_path):
    env, output = environment(), tmp_path / "output.txt"
    file = parameter_file(tmp_path / "own.yaml", observer={"cpus": "none"})
    command = [*module("bringup.bringup"), "--ros-args", "-p", f"parameters:={file}", "-p", "scene:=free"]
    with running(command, env, output) as process:
        assert process.wait(300) == 1
    text = output.read_text()
    assert "observer ended (exit code 2)" in text and "parameter cpus: 'none'" in text
    assert_nothing_left(env)
