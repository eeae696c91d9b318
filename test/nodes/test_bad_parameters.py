"""A node with wrong parameters does not start, and names file and key."""

import subprocess

import pytest
from stack_helpers import environment, module, parameter_file

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.presets import SECTIONS
from contact_reach_ros.ros.parameters import check_arguments


def check(node, *arguments):
    check_arguments([node, "--ros-args", *arguments], node, SECTIONS[node])


@pytest.mark.parametrize(
    ("node", "content", "key"),
    [
        *((name, {"no_such_thing": 1}, "no_such_thing") for name in SECTIONS if name != "bringup"),
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


def test_a_wrong_argument_is_named():
    with pytest.raises(SettingsError, match="no_such_thing"):
        check("planner", "-p", "no_such_thing:=5.0")


LONG_NAME = "a" * 300
"""No file can have it."""


@pytest.mark.parametrize(
    ("program", "argument", "words"),
    [
        ("nodes.driver", "scene:=bad.yaml", "40.0 mm inside the ball"),
        ("nodes.recorder", f"bag:={LONG_NAME}", LONG_NAME[:20]),
        ("bringup.bringup", f"parameters:={LONG_NAME}", LONG_NAME[:20]),
    ],
)
def test_a_process_ends_with_the_message(program, argument, words, tmp_path):
    scene = tmp_path / "bad.yaml"
    scene.write_text("base: ball\ntarget: {position: [0.5, 0.2, 0.3]}\nball: {center: [0.5, 0.26, 0.3]}\n")
    command = [*module(program), "--ros-args", "-p", argument]
    result = subprocess.run(command, env=environment(), cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert result.returncode not in (0, -9) and words in result.stderr and "Traceback" not in result.stderr
