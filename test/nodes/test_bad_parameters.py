"""A node with wrong parameters does not start, and names file and key."""

import subprocess

import pytest
from stack_helpers import environment, module, parameter_file

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.presets import SECTIONS
from contact_reach_ros.ros.parameters import check_arguments


def check(node, *arguments):
    check_arguments([node, "--ros-args", *arguments], node, SECTIONS[node])


@pytest.mark.parametrize("node", ["driver", "controller", "observer", "planner", "adapter", "recorder"])
def test_an_unknown_key_is_named_with_its_file(node, tmp_path):
    file = parameter_file(tmp_path / "wrong.yaml", **{node: {"no_such_thing": 1}})
    with pytest.raises(SettingsError) as refused:
        check(node, "--params-file", str(file))
    assert str(file) in str(refused.value) and "no_such_thing" in str(refused.value)
    with pytest.raises(SettingsError, match="no_such_thing"):
        check(node, "-p", "no_such_thing:=5.0")


@pytest.mark.parametrize(
    ("node", "content", "key"),
    [
        ("controller", {"impedance": {"task_stiffness": -1.0}}, "impedance.task_stiffness"),
        ("observer", {"momentum": {"gain": "high"}}, "momentum.gain"),
        ("driver", {"seed": 1.5}, "seed"),
        ("adapter", {"kind": "hydraulic"}, "kind"),
    ],
)
def test_a_value_that_is_not_accepted_is_named_with_what_is(node, content, key, tmp_path):
    file = parameter_file(tmp_path / "wrong.yaml", **{node: content})
    with pytest.raises(SettingsError, match="expected") as refused:
        check(node, "--params-file", str(file))
    assert str(file) in str(refused.value) and key in str(refused.value)


def test_a_process_ends_with_the_message(tmp_path):
    scene = tmp_path / "bad.yaml"
    scene.write_text("base: ball\ntarget: {position: [0.5, 0.2, 0.3]}\nball: {center: [0.5, 0.26, 0.3]}\n")
    for argument, words in ((f"scene:={scene}", "40.0 mm inside the ball"), ("seed:=1.5", "expected")):
        command = [*module("nodes.driver"), "--ros-args", "-p", argument]
        result = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60)
        assert result.returncode == 2 and words in result.stderr and "Traceback" not in result.stderr
