"""Whole configurations by name: what the nodes run, and the paper's own in both readings of its cost."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.parameter_files import DEFAULT_PARAMETERS, make_settings, parameters_in
from contact_reach_ros.planning.node_settings import (
    PLANNER_SECTIONS,
    ReplanningSettings,
    UnexpectedContactSettings,
)
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.resources import config_file

PRESETS = {
    "paper_linear": "presets/paper_linear.yaml",
    "paper_hinge": "presets/paper_hinge.yaml",
    "shipped": DEFAULT_PARAMETERS,
}
"""Parameter files in config/ by the name of the preset."""


class Preset(NamedTuple):
    """Settings by the arguments of `Stack` that take them: `Stack(scene, **preset("paper_hinge")._asdict())`."""

    planning: PlanningSettings
    replanning: ReplanningSettings
    controller: ControllerSettings
    unexpected_contact: UnexpectedContactSettings


def preset_file(name: str) -> Path:
    """The parameter file that holds a preset; raises `SettingsError` if there is no preset of this name."""
    if name not in PRESETS:
        raise SettingsError(f"preset '{name}' is unknown; expected one of {', '.join(PRESETS)}")
    return config_file(PRESETS[name])


def preset(name: str, arm: Arm | None = None) -> Preset:
    """The settings of a preset, 'paper_linear', 'paper_hinge' or 'shipped', for an arm; None for the iiwa 14.

    Raises `SettingsError` if there is no preset of this name, or its file has a value that is not accepted.
    """
    file, arm = preset_file(name), arm or load_arm()

    def settings(node: str, sections: Any) -> dict[str, Any]:
        return make_settings(parameters_in(file, node), sections, arm, str(file))

    planner, controller = settings("planner", PLANNER_SECTIONS), settings("controller", CONTROLLER_SECTIONS)
    names = [field.name for field in dataclasses.fields(ReplanningSettings)]
    return Preset(
        planning=planner["planning"],
        replanning=ReplanningSettings(**{name: getattr(planner[""], name) for name in names}),
        controller=ControllerSettings(
            **{field.name: controller[field.name] for field in dataclasses.fields(ControllerSettings)}
        ),
        unexpected_contact=planner["unexpected_contact"],
    )
