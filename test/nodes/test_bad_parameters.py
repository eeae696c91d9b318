"""A node with wrong parameters does not start, and names file and key."""

import subprocess

import pytest
from stack_helpers import environment, module, parameter_file

NODES = ("driver", "controller", "observer", "planner", "adapter", "recorder")


def start(node, *arguments):
    return subprocess.run(
        [*module(f"nodes.{node}"), "--ros-args", *arguments],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_key_is_named_with_its_file(node, tmp_path):
    file = parameter_file(tmp_path / "wrong.yaml", **{node: {"no_such_thing": 1}})
    result = start(node, "--params-file", str(file))
    assert result.returncode == 2
    assert str(file) in result.stderr and "no_such_thing" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("node", "content", "key"),
    [
        ("controller", {"impedance": {"task_stiffness": -1.0}}, "impedance.task_stiffness"),
        ("controller", {"impedance": {"task_stiffnes": 880.0}}, "did you mean 'impedance.task_stiffness'"),
        ("observer", {"momentum": {"gain": "high"}}, "momentum.gain"),
        ("planner", {"period": 0.0}, "period"),
        ("driver", {"seed": 1.5}, "seed"),
        ("adapter", {"kind": "hydraulic"}, "kind"),
    ],
)
def test_a_value_out_of_range_is_named_with_what_is_accepted(node, content, key, tmp_path):
    file = parameter_file(tmp_path / "wrong.yaml", **{node: content})
    result = start(node, "--params-file", str(file))
    assert result.returncode == 2
    assert str(file) in result.stderr and key in result.stderr
    assert "expected" in result.stderr or "did you mean" in result.stderr


def test_an_unknown_key_on_the_command_line_is_named():
    result = start("controller", "-p", "impedance.stiffness:=5.0")
    assert result.returncode == 2
    assert "impedance.stiffness" in result.stderr


def test_a_missing_parameter_file_is_named(tmp_path):
    result = start("controller", "--params-file", str(tmp_path / "none.yaml"))
    assert result.returncode == 2
    assert "none.yaml" in result.stderr


def test_a_scene_that_cannot_be_keeps_the_driver_from_starting(tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text("base: ball\ntarget: {position: [0.5, 0.2, 0.3]}\nball: {center: [0.5, 0.26, 0.3]}\n")
    result = start("driver", "-p", f"scene:={file}")
    assert result.returncode == 2
    assert str(file) in result.stderr and "40.0 mm inside the ball" in result.stderr
    assert "Traceback" not in result.stderr
