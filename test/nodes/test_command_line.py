"""Executables explain themselves, refuse what ROS would silently ignore, and name file and key of wrong parameters."""

import sys
from functools import partial

import pytest
from stack_helpers import environment, parameter_file

from contact_reach_ros import executables
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup import bringup
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.presets import SECTIONS
from contact_reach_ros.ros.parameters import check_arguments
from contact_reach_ros.ros.process import run
from contact_reach_ros.settings import NODES, declared_parameters

pytestmark = pytest.mark.usefixtures("signal_handlers")


@pytest.mark.parametrize("node", NODES)
def test_help_lists_all_parameters(node, monkeypatch, capsys):
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
    assert check_arguments(arguments, "driver", SECTIONS["driver"])[""].seed == 1
    with pytest.raises(SettingsError, match="unknown arguments"):
        check_arguments([*arguments, "left"], "driver", SECTIONS["driver"])


def check(node, *arguments):
    check_arguments([node, "--ros-args", *arguments], node, SECTIONS[node])


@pytest.mark.parametrize(
    ("node", "content", "key"),
    [
        ("viewer", {"no_such_thing": 1}, "no_such_thing"),
        ("controller", {"impedance": {"task_stiffness": -1.0}}, "impedance.task_stiffness"),
        ("observer", {"momentum": {"gain": "high"}}, "momentum.gain"),
        ("driver", {"seed": 1.5}, "seed"),
        ("adapter", {"kind": "hydraulic"}, "kind"),
    ],
)
def test_a_wrong_parameter_is_named_with_its_file_and_with_what_is_accepted(node, content, key, tmp_path):
    file = parameter_file(tmp_path / "wrong.yaml", **{node: content})
    with pytest.raises(SettingsError, match=r"expected|known keys") as refused:
        check(node, "--params-file", str(file))
    assert str(file) in str(refused.value) and key in str(refused.value)
    with pytest.raises(SettingsError, match=r"argument -p no_such_thing:=5\.0: unknown key 'no_such_thing'"):
        check(node, "-p", "no_such_thing:=5.0")


@pytest.mark.parametrize(
    ("program", "argument", "words"),
    [
        (partial(run, DriverNode), "scene:=bad.yaml", "40.0 mm inside the ball"),
        # A name that no file can have.
        (partial(run, RecorderNode), f"bag:={'a' * 300}", "aaaaaaaaaaaaaaaa"),
        (bringup.run_bringup, f"parameters:={'a' * 300}", "aaaaaaaaaaaaaaaa"),
    ],
    ids=["driver", "recorder", "bringup"],
)
def test_a_process_ends_with_the_message(program, argument, words, tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", environment()["ROS_DOMAIN_ID"])
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.chdir(tmp_path)
    scene = tmp_path / "bad.yaml"
    scene.write_text("base: ball\ntarget: {position: [0.5, 0.2, 0.3]}\nball: {center: [0.5, 0.26, 0.3]}\n")
    assert program(["program", "--ros-args", "-p", argument]) in (1, 2)
    printed = capfd.readouterr().err
    assert words in printed and "Traceback" not in printed
