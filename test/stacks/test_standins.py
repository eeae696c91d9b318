"""The stack on the conventions of real drivers, through the adapter: goals are reached, and silence is harmless."""

import os
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from contact_reach_command import contact_reach
from message_packages import message_packages
from stack_helpers import SMALL_PLANNER, command_lines, environment, module, processes_of_domain, ready, running

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.resources import config_file

THERE, AWAY = "goto 0.51 0.025 0.145 --wait", "goto 0.45 -0.45 0.35"
"""The second goal is half a metre from the first: the arm is on its way for some seconds after it is taken."""
BRAKES = {"effort": "", "lbr": "the connection is closed", "franka": "no controller is active"}
"""Why each driver closes the brakes after a stop of the adapter; the first one does not."""
STOPPED_FOR_S = 1.5


@pytest.fixture(scope="module")
def packages():
    """Environment variables with which processes import the message packages of the drivers."""
    folders = message_packages()
    return {"PYTHONPATH": os.pathsep.join((*folders, *filter(None, [os.environ.get("PYTHONPATH")])))}


def parameters_of(kind, path):
    """The parameter file that bring-up takes for a kind, with a planner that compiles faster."""
    content = yaml.safe_load(config_file(f"{'default' if kind == 'effort' else kind}.yaml").read_text())
    planner = content.setdefault("planner", {}).setdefault("ros__parameters", {})
    planner["planning"] = {**planner.get("planning", {}), **SMALL_PLANNER["planning"]}
    path.write_text(yaml.safe_dump(content))
    return str(path)


@contextmanager
def stack(kind, rate, lockstep, env, folder, scene="ball"):
    """A driver of that kind, and the stack on it; yields what the driver prints."""
    output, drivers = folder / "up.txt", folder / "driver.txt"
    driver = [sys.executable, str(Path(__file__).with_name("standins.py")), kind, "--ros-args"]
    driver += ["-p", f"scene:={scene}", "-p", f"state_rate:={rate}.0"]
    up = [*module("cli"), "up", "--no-driver", "--adapter", kind, "--state-rate", str(rate)]
    up += ["--parameters", parameters_of(kind, folder / "parameters.yaml"), "--bag", str(folder / "bag")]
    if lockstep:
        driver += ["-p", "lockstep:=true", "-p", "waits_for:=adapter"]
        up.append("--lockstep")
    with running(up, env, output) as process:
        ready(process, output)
        # Simulated time begins with the driver: nobody may miss its first state.
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


@pytest.mark.parametrize(
    "kind", [kind if kind == "lbr" else pytest.param(kind, marks=pytest.mark.slow) for kind in BRAKES]
)
def test_in_real_time_a_controller_that_stands_still_in_motion_leaves_the_arm_at_rest(kind, packages, tmp_path):
    """The quick run takes the driver with a protocol of its own. Nothing is in the way: real time may be a busy one."""
    env = {**environment(), **packages}
    with stack(kind, 500, False, env, tmp_path, "free") as drivers:
        there, away = command_lines(env, THERE, AWAY)
        assert (there[0], away[0]) == (0, 0), (there, away)
        controller = processes_of_domain(env["ROS_DOMAIN_ID"])["controller"]
        os.kill(controller, signal.SIGSTOP)
        stood_ns = time.time_ns()
        time.sleep(STOPPED_FOR_S)
        went_on_ns = time.time_ns()
        os.kill(controller, signal.SIGCONT)
        said = drivers.read_text()
        assert BRAKES[kind] in said and ("brakes closed: " in said) == bool(BRAKES[kind])
    bag = BagReader(tmp_path / "bag")
    stops = [each.message.message for each in bag.messages(["/safety_state"]) if each.message.name == "adapter"]
    assert any(text.startswith("no command for") for text in stops)
    states = [each.message for each in bag.messages(["/joint_states"])]
    times = np.array([nanoseconds(state.header.stamp) for state in states])
    speeds = np.abs([state.velocity for state in states]).max(axis=1)
    before = speeds[(times > stood_ns - 50_000_000) & (times < stood_ns)]
    after = speeds[(times > stood_ns + 700_000_000) & (times < went_on_ns)]
    assert before.max() > 0.1
    # KUKA's driver reports nothing any more once its connection is closed.
    assert (after < 0.05).all() and (len(after) or kind == "lbr")
