"""Executables explain themselves without starting anything, and refuse arguments that ROS would silently ignore."""

import sys

import pytest

from contact_reach_ros import executables
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup import bringup
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.presets import SECTIONS
from contact_reach_ros.ros.parameters import check_arguments
from contact_reach_ros.ros.process import run
from contact_reach_ros.settings import NODES, declared_parameters


@pytest.mark.parametrize("node", NODES)
def test_help_lists_all_parameters(node, monkeypatch, capsys):
    # It would replace the signal handlers of the tests' own process.
    monkeypatch.setattr(executables, "end_at_signals", lambda: None)
    monkeypatch.setattr(sys, "argv", [node, "--help"])
    getattr(executables, node)()
    page = capsys.readouterr().out
    for name, entry in declared_parameters(SECTIONS[node], load_arm()).items():
        (line,) = (text for text in page.splitlines() if text.startswith(f"  {name} ("))
        assert entry.accepts in line and line.endswith(entry.description)
    assert ("autostart" in page) == (node != "bringup")


@pytest.mark.parametrize("arguments", ["--speed 3", "seed:=3 --ros-args -p state_rate:=500"])
def test_arguments_that_are_not_for_ros_are_refused(arguments, capsys):
    assert run(RecorderNode, ["recorder", *arguments.split()]) == 2
    assert bringup.run_bringup(["bringup", *arguments.split()]) == 2
    refusal = f"{arguments.split(' --ros-args')[0]}: unknown arguments; expected --ros-args -p NAME:=VALUE"
    printed = capsys.readouterr().err
    assert f"recorder: {refusal}" in printed and f"bringup: {refusal}" in printed


def test_what_launch_files_pass_is_accepted(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("driver: {ros__parameters: {seed: 3}}")
    passed = f"--ros-args --enclave /contact_reach/driver --ros-args -r __node:=driver --params-file {file} -p seed:=1"
    arguments = f"driver {passed} --log-level driver:=debug --disable-stdout-logs --".split()
    assert check_arguments(arguments, "driver", SECTIONS["driver"]).name == "iiwa14"
    with pytest.raises(SettingsError, match="unknown arguments"):
        check_arguments([*arguments, "left"], "driver", SECTIONS["driver"])
