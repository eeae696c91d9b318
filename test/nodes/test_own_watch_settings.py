"""The controller watches itself with the observer's settings, or not at all."""

import json

import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from stack_helpers import parameter_file, ros

from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.messages.safety_state import observer_values, requires_observer
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.ros.parameters import check_arguments


@pytest.fixture
def file(tmp_path):
    """A parameter file with other settings of the observer."""
    own = {"safety": {"debounce": 5}, "momentum": {"viscous_friction": [0.5] * 7}}
    return str(parameter_file(tmp_path / "own.yaml", observer=own))


def not_yet(monkeypatch, file: str, *arguments: str) -> str:
    """Why a controller with these arguments does not start beside an observer with the file."""
    monkeypatch.setattr(ControllerNode, "ARGUMENTS", ["controller", *arguments])
    with ros("--ros-args", "--params-file", file):
        controller, observer = ControllerNode(), ObserverNode()
        values = [KeyValue(key=key, value=json.dumps(value)) for key, value in observer.reported_settings().items()]
        controller._on_settings(DiagnosticStatus(name="observer", values=values))
        controller.look_around()
        return controller._controller.not_yet


def test_with_the_same_file_they_agree(monkeypatch, file):
    assert not_yet(monkeypatch, file, "--ros-args", "--params-file", file) == ""


def test_a_difference_keeps_the_arm_from_being_started_and_is_named(monkeypatch, file):
    found = not_yet(monkeypatch, file, "--ros-args", "--params-file", file, "-p", "observer:safety.debounce:=4")
    assert found.startswith(
        "observer and controller disagree: safety.debounce = 5 in the observer, 4 in the controller;"
    )
    assert "viscous_friction" in not_yet(monkeypatch, file)


def test_bring_up_gives_the_controller_what_it_changes_in_the_observer():
    table = {process.name: process for process in processes(BringupOptions(overrides=("observer:safety.debounce=5",)))}
    assert table["controller"].parameters["observer:safety.debounce"] == 5
    check_arguments(
        ["controller", "--ros-args", "-p", "observer:safety.debounce:=5"], "controller", ControllerNode.SECTIONS
    )


@pytest.mark.parametrize("is_required", [True, False])
def test_whether_an_observer_is_required_can_be_read(is_required):
    values = [KeyValue(key=key, value=value) for key, value in observer_values(is_required).items()]
    assert requires_observer(DiagnosticStatus(values=values)) is is_required
