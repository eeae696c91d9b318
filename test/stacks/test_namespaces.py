"""Two stacks on one host, in one ROS domain, each in a namespace of its own."""

import signal
import subprocess
from contextlib import ExitStack

import pytest
from contact_reach_command import contact_reach
from stack_helpers import (
    SMALL_PLANNER,
    environment,
    module,
    parameter_file,
    processes_of_domain,
    ready,
    running,
    wait_for,
)

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bringup.bringup import _remappings
from contact_reach_ros.messages.topics import OF_OTHERS

NAMES = ("left", "right")


def test_remappings_of_bringup_hold_for_all_nodes():
    given = ["bringup", "--ros-args", "-r", "__ns:=/left", "--remap", "a:=b", "-p", "view:=true", "-r", "/c:=d"]
    assert _remappings(given) == ["--remap", "a:=b", "-r", "/c:=d"]


@pytest.mark.slow
def test_two_stacks_reach_their_goals_beside_each_other(tmp_path, capsys):
    env = {**environment(), "COLUMNS": "400"}
    file = parameter_file(
        tmp_path / "small.yaml", planner=SMALL_PLANNER, controller={"supervision": {"hold_limit": 1000.0}}
    )
    options = ["--lockstep", "--scene", "free", "--parameters", str(file)]

    def command(name, *arguments):
        line = [*module("cli"), *arguments, "--namespace", name]
        return subprocess.run(line, env=env, capture_output=True, text=True, timeout=300)

    with ExitStack() as stack:
        processes = {}
        for name in NAMES:
            up = [*module("cli"), "up", "--namespace", name, "--bag", str(tmp_path / name), *options]
            processes[name] = stack.enter_context(running(up, env, tmp_path / f"{name}.txt"))
        for name, process in processes.items():
            ready(process, tmp_path / f"{name}.txt")
        for name in NAMES:
            result = command(name, "goto", "0.5", "0.1", "0.3", "--wait", "--timeout", "60")
            assert result.returncode == 0 and "settled: " in result.stdout, result.stdout + result.stderr
        assert command("left", "stop").returncode == 0
        assert command("right", "goto", "0.5", "0.0", "0.3").returncode == 0, "the other one is not stopped"
        found = command("left", "doctor").stdout
        assert "left/driver → " in found and "reset --namespace /left" in found and "right/" not in found, found
        assert "namespace /: safety_state" in command("", "stop").stderr, "there is none outside of the namespaces"
        for name in NAMES:
            processes[name].send_signal(signal.SIGINT)
        for name in NAMES:
            assert processes[name].wait(60) == 0
    wait_for(lambda: not processes_of_domain(env["ROS_DOMAIN_ID"]), 20, "all processes have ended")
    for name in NAMES:
        topics = BagReader(tmp_path / name).topics
        own = topics.keys() - set(OF_OTHERS)
        assert f"/{name}/joint_states" in own and all(topic.startswith(f"/{name}/") for topic in own)
        assert contact_reach("reexecute", tmp_path / name) == 0 and capsys.readouterr().out.count("identical") == 2
