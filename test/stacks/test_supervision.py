"""Whatever process dies, the arm is left at rest, one message names the reason, and no process stays behind."""

import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from stack_helpers import SMALL_PLANNER, environment, module, parameter_file, processes_of_domain, running, wait_for

from contact_reach_ros.arms import load_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import read_signals

PATIENT_PLANNER = {**SMALL_PLANNER, "latency": 0.25}
"""Has a quarter of a second for each plan: with less, a busy machine makes every plan too late to take effect, until
the controller stops the arm before it has moved."""
REST = 0.1
"""Joint speed that counts as rest, sensor noise included, rad/s."""
ATTEMPTS = 3
"""On a machine that stands still for a while the arm is rightly stopped before it has moved: that shows nothing."""


@pytest.fixture
def moving_demo(tmp_path):
    """A demo in real time whose arm is on its way: environment, process, output file and folder."""
    parameters = parameter_file(tmp_path / "small.yaml", planner=PATIENT_PLANNER)
    for attempt in range(ATTEMPTS):
        env, folder = environment(), tmp_path / str(attempt)
        folder.mkdir()
        output = folder / "output.txt"
        command = [*module("cli"), "demo", "--scene", "free", "--output", str(folder), "--parameters", str(parameters)]
        with running(command, env, output) as process:
            wait_for(lambda: moved(output) or process.poll() is not None, 300, "the arm moves")  # noqa: B023
            if process.poll() is None:
                yield env, process, output, folder
                return
    pytest.fail(f"the arm did not move in {ATTEMPTS} demos; the last one printed: {output.read_text()}")


def moved(output: Path) -> bool:
    """Whether the demo's progress shows the arm on its way."""
    distances = [float(text) for text in re.findall(r"distance +([0-9.]+) mm", output.read_text())]
    return bool(distances) and distances[-1] < distances[0] - 10.0


def assert_nothing_left(env):
    wait_for(lambda: not processes_of_domain(env["ROS_DOMAIN_ID"]), 20, "all processes of the stack have ended")


@pytest.mark.parametrize(
    "victim",
    [
        "controller",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("observer", "planner", "driver", "recorder")),
    ],
)
def test_a_killed_node_ends_the_stack_with_the_arm_at_rest(moving_demo, victim):
    env, process, output, folder = moving_demo
    os.kill(processes_of_domain(env["ROS_DOMAIN_ID"])[victim], signal.SIGKILL)
    assert process.wait(120) == 1
    text = output.read_text()
    assert text.count(f"{victim} ended (killed by SIGKILL)") == 1 and "Traceback" not in text
    assert_nothing_left(env)
    (bag,) = (path for path in folder.glob("demo_*") if path.is_dir())
    speeds = np.abs(read_signals(BagReader(bag), load_arm()).velocity.values).max(axis=1)
    assert speeds.max() > REST, "the arm never moved: the test shows nothing"
    if victim not in ("driver", "recorder"):
        # The last tenth of a second of the bag; without a driver there is no arm, without a recorder no bag.
        assert speeds[-100:].max() < REST


def test_bringup_names_the_node_that_cannot_start(tmp_path):
    env, output = environment(), tmp_path / "output.txt"
    file = parameter_file(tmp_path / "own.yaml", observer={"cpus": "none"})
    command = [*module("bringup.bringup"), "--ros-args", "-p", f"parameters:={file}", "-p", "scene:=free"]
    with running(command, env, output) as process:
        assert process.wait(300) == 1
    text = output.read_text()
    assert "observer ended (exit code 2)" in text and "parameter cpus: 'none'" in text
    assert_nothing_left(env)
