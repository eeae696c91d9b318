"""The stack on the conventions of real drivers, through the adapter: goals are reached, and silence is harmless."""

import os
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from contact_reach_command import contact_reach
from message_packages import message_packages
from stack_helpers import (
    PATIENT_PLANNER,
    SMALL_PLANNER,
    command_lines,
    environment,
    module,
    processes_of_domain,
    ready,
    running,
    speeds_until,
    wait_for,
)

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages.safety_state import ERROR
from contact_reach_ros.resources import config_file

THERE, AWAY = "goto 0.51 0.025 0.145 --wait", "goto 0.45 -0.45 0.35"
"""The second goal is half a metre from home: the arm is on its way for some seconds."""
BRAKES = {"effort": "", "lbr": "the connection is closed", "franka": "no controller is active"}
"""Why each driver closes the brakes after a stop of the adapter; the first one does not."""
MOVES, RESTS = 0.15, 0.05
"""Speed of a joint that moves, and of one at rest, rad/s."""
ATTEMPTS = 3
"""On a machine that stands still for a while the arm is rightly stopped before it has moved: that shows nothing."""


@pytest.fixture(scope="module")
def packages():
    """Environment variables with which processes import the message packages of the drivers."""
    folders = message_packages()
    return {"PYTHONPATH": os.pathsep.join((*folders, *filter(None, [os.environ.get("PYTHONPATH")])))}


def parameters_of(kind, path, small):
    """The parameter file that bring-up takes for a kind, with a small planner, which compiles faster."""
    content = yaml.safe_load(config_file(f"{'default' if kind == 'effort' else kind}.yaml").read_text())
    planner = content.setdefault("planner", {}).setdefault("ros__parameters", {})
    planner.update(small, planning={**planner.get("planning", {}), **small["planning"]})
    path.write_text(yaml.safe_dump(content))
    return str(path)


@contextmanager
def stack(kind, rate, lockstep, env, folder, scene="ball"):
    """A driver of that kind, and the stack on it; yields what the driver prints."""
    output, drivers = folder / "up.txt", folder / "driver.txt"
    driver = [sys.executable, str(Path(__file__).with_name("standins.py")), kind, "--ros-args"]
    driver += ["-p", f"scene:={scene}", "-p", f"state_rate:={rate}.0"]
    up = [*module("cli"), "up", "--no-driver", "--adapter", kind, "--state-rate", str(rate)]
    parameters = parameters_of(kind, folder / "parameters.yaml", SMALL_PLANNER if lockstep else PATIENT_PLANNER)
    up += ["--parameters", parameters, "--bag", str(folder / "bag")]
    if lockstep:
        driver += ["-p", "use_sim_time:=true"]
        up.append("--lockstep")
    with running(up, env, output) as process:
        ready(process, output)
        with running(driver, env, drivers) as process:
            ready(process, drivers, "active")
            yield drivers


@pytest.mark.slow
@pytest.mark.parametrize("rate", [200, 500, 1000])
@pytest.mark.parametrize("kind", BRAKES)
def test_the_goal_is_reached_through_each_driver_at_its_rate(kind, rate, packages, tmp_path, capsys):
    env = {**environment(), **packages}
    with stack(kind, rate, True, env, tmp_path):
        ((code, said),) = command_lines(env, THERE)
    assert (code, said[:9]) == (0, "settled: ")
    assert contact_reach("reexecute", tmp_path / "bag") == 0 and capsys.readouterr().out.count("identical") == 2


def stand_still_in_motion(kind, env, folder):
    """Have the controller stand still when the arm is on its way; what the driver said until the arm was at rest.

    None if the arm did not move.
    """
    folder.mkdir()
    domain = env["ROS_DOMAIN_ID"]
    with stack(kind, 500, False, env, folder, "free") as drivers:
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
