"""The controller watches itself with the observer's settings, or not at all."""

import json

import pytest
from stack_helpers import parameter_file, ros

from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.messages.conversions import to_status
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.ros.parameters import check_arguments

CHANGE = ("-p", "observer:safety.debounce:=4")


@pytest.mark.parametrize(
    ("has_file", "others", "found"),
    [
        (True, (), ""),
        (True, CHANGE, "observer and controller disagree: safety.debounce = 5 in the observer, 4 in the controller;"),
        (False, (), "momentum.viscous_friction"),
    ],
)
def test_a_difference_keeps_the_arm_from_being_started_and_is_named(monkeypatch, tmp_path, has_file, others, found):
    own = {"safety": {"debounce": 5}, "momentum": {"viscous_friction": [0.5] * 7}}
    file = ("--params-file", str(parameter_file(tmp_path / "own.yaml", observer=own)))
    arguments = (*(file if has_file else ()), *others)
    monkeypatch.setattr(ControllerNode, "ARGUMENTS", ["controller", *(("--ros-args", *arguments) if arguments else ())])
    with ros(more=file):
        controller, observer = ControllerNode(), ObserverNode()
        values = {key: json.dumps(value) for key, value in observer.reported_settings().items()}
        controller._on_settings(to_status("observer", "", values))
        controller.look_around()
        said = controller._controller.not_yet
    assert found in said and bool(said) == bool(found)


def test_bring_up_gives_the_controller_what_it_changes_in_the_observer():
    table = {process.name: process for process in processes(BringupOptions(overrides=("observer:safety.debounce=5",)))}
    assert table["controller"].parameters["observer:safety.debounce"] == 5
    check_arguments(["controller", "--ros-args", *CHANGE], "controller", ControllerNode.SECTIONS)
