"""Every executable explains itself without starting anything, and refuses what ROS would silently ignore."""

import importlib
import sys

import pytest

from contact_reach_ros import executables
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup import bringup
from contact_reach_ros.command_line import foreign_arguments
from contact_reach_ros.node_settings import ALL_SECTIONS
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.parameter_files import NODES, declared_parameters
from contact_reach_ros.ros.process import run
from contact_reach_ros.ros.scheduling import Role


@pytest.fixture
def nothing_starts(monkeypatch):
    real = importlib.import_module

    def import_module(name):
        assert not name.startswith(("contact_reach_ros.nodes", "contact_reach_ros.bringup")), "takes seconds"
        return real(name)

    monkeypatch.setattr(importlib, "import_module", import_module)
    # Of the process that runs the tests others take care.
    monkeypatch.setattr(executables, "end_at_signals", lambda: None)


@pytest.mark.parametrize("node", NODES)
def test_help_lists_all_parameters(node, nothing_starts, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [node, "--help"])
    with pytest.raises(SystemExit) as ended:
        getattr(executables, node)()
    assert not ended.value.code
    page = capsys.readouterr().out
    for name, entry in declared_parameters(ALL_SECTIONS[node], load_arm()).items():
        (line,) = (text for text in page.splitlines() if text.startswith(f"  {name} ("))
        assert line.endswith(f": {entry.accepts}")
    assert NODES[node] in page and ("autostart" in page) == (node != "bringup")


WRITTEN = {
    "--scene wall scene:=wall": "-p scene:=wall,",
    "--scene=wall --lockstep": "-p scene:=wall -p lockstep:=true,",
    "--state-rate 500": "-p state_rate:=500,",
    "seed:=3 --ros-args -p scene:=free": "-p seed:=3,",
    "--ros-args scene:=wall": "-p scene:=wall,",
    "--ros-args -p scene:=free -- --speed 3": "-p NAME:=VALUE,",
}


@pytest.mark.parametrize("arguments", WRITTEN)
def test_what_is_none_of_ros_is_refused_with_what_to_write(arguments, nothing_starts, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bringup", *arguments.split()])
    with pytest.raises(SystemExit) as ended:
        executables.bringup()
    assert ended.value.code == 2
    assert f"write --ros-args {WRITTEN[arguments]} see bringup --help" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--help"], ["--speed", "3"]])
def test_modules_answer_as_executables_do(arguments, capsys):
    code = 0 if arguments == ["--help"] else 2
    assert run(RecorderNode, Role.BACKGROUND, ["recorder", *arguments]) == code
    assert bringup.run_bringup(["bringup", *arguments]) == code
    printed = capsys.readouterr()
    assert "usage: bringup" in printed.out if code == 0 else "recorder: --speed 3: not understood" in printed.err


def test_what_launch_files_pass_is_accepted():
    passed = "--ros-args --enclave /contact_reach/driver --ros-args -r __node:=driver --params-file a.yaml -p seed:=-1"
    assert foreign_arguments(f"{passed} --log-level driver:=debug --disable-stdout-logs --".split()) == []
