"""Whole configurations: the settings of all nodes, the check of a file with them, and those that have a name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import TOOL_PARAMETERS, arm_in, known_parameters, load_arm, make_settings
from contact_reach_ros.bags.settings import RECORDER_SECTIONS
from contact_reach_ros.bringup.settings import BRINGUP_SECTIONS
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS, ControllerSettings
from contact_reach_ros.drives.settings import ADAPTER_SECTIONS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.planning.settings import (
    PLANNER_SECTIONS,
    PlanningSettings,
    ReplanningSettings,
    UnexpectedContactSettings,
)
from contact_reach_ros.removed import removed_parameter
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import (
    DEFAULT_PARAMETERS,
    RATE,
    ROBOT,
    Sections,
    check_node_names,
    parameters_in,
)
from contact_reach_ros.simulation.settings import DRIVER_SECTIONS, check_period
from contact_reach_ros.viewer.settings import VIEWER_SECTIONS

SECTIONS: Mapping[str, Sections] = {
    "driver": DRIVER_SECTIONS,
    "controller": CONTROLLER_SECTIONS,
    "observer": OBSERVER_SECTIONS,
    "planner": PLANNER_SECTIONS,
    "adapter": ADAPTER_SECTIONS,
    "recorder": RECORDER_SECTIONS,
    "viewer": VIEWER_SECTIONS,
    "bringup": BRINGUP_SECTIONS,
}
"""Settings of each of `NODES`, as classes by parameter prefix."""

_NEEDED = ("controller", "observer", "planner")
_ONE_CLOCK = ("driver", "adapter", *_NEEDED)
"""Nodes that count joint states: they must have the same arm and rate."""

Given = Mapping[str, Mapping[str, Any]]

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


def preset(name: str, arm: Arm | None = None) -> Preset:
    """The settings of a preset, 'paper_linear', 'paper_hinge' or 'shipped', for an arm; None for the iiwa 14.

    Raises `SettingsError` if there is no preset of this name, or its file has a value that is not accepted.
    """
    if name not in PRESETS:
        raise SettingsError(f"preset '{name}' is unknown; expected one of {', '.join(PRESETS)}")
    file, arm = config_file(PRESETS[name]), arm or load_arm()

    planner, controller = (
        make_settings(parameters_in(file, node), SECTIONS[node], arm, f"{file}: {node}")
        for node in ("planner", "controller")
    )
    return Preset(
        planning=planner["planning"],
        replanning=planner[""],
        controller=ControllerSettings.from_sections(controller),
        unexpected_contact=planner["unexpected_contact"],
    )


def check_parameters(file: Path, given: Given | None = None, robot: str = "", namespace: str = "/") -> None:
    """Check names of nodes and parameters, values, and what must be the same in several nodes.

    Controller and planner cannot have different gains: both read those of the section `controller`. In the same way the
    controller reads the settings of the observer with which it watches itself.

    Parameters
    ----------
    file
        Parameter file of all nodes.
    given
        Parameters that come on top of the file's, by the nodes that are started; None while nobody knows which are.
    robot
        Arm of all nodes, in place of the file's; the file's when empty.
    namespace
        Of the nodes.

    Raises
    ------
    SettingsError
        Naming the file, node and parameter, and what is expected.
    """
    check_node_names(file)
    values: dict[str, dict[str, Any]] = {}
    settings: dict[str, dict[str, Any]] = {}
    arms: dict[str, Arm] = {}
    for node, sections in SECTIONS.items():
        source = f"{file}: {node}"
        added = {name.removeprefix(f"{node}:"): value for name, value in (given or {}).get(node, {}).items()}
        # Names with a colon are parameters of other nodes.
        added = {name: value for name, value in added.items() if ":" not in name}
        own = parameters_in(file, node, namespace) | ({ROBOT.name: robot} if robot else {}) | added
        values[node] = own
        arms[node] = arm_in(own, source)
        _check_owner(own, node, arms[node], source)
        settings[node] = make_settings(own, sections, arms[node], source)
    started = _NEEDED if given is None else tuple(given)
    known = known_parameters({}, arms["controller"])
    for name in (ROBOT.name, RATE.name, *TOOL_PARAMETERS):
        given_to = {node: values[node].get(name, known[name].default) for node in _ONE_CLOCK if node in started}
        _check_same(file, name, {node: known[name].check(value, name) for node, value in given_to.items()})
    rate: Any = values["controller"].get(RATE.name, RATE.default)
    _check_together(file, settings, arms["controller"], 1.0 / rate, started)


def _check_owner(names: Iterable[str], node: str, arm: Arm, source: str) -> None:
    """Check that no parameter is one of other nodes only."""
    known = {other: known_parameters(sections, arm) for other, sections in SECTIONS.items()}
    for name in names:
        if name in known[node] or removed_parameter(name):
            continue
        if owners := [other for other in SECTIONS if name in known[other]]:
            raise SettingsError(f"{source}: unknown key '{name}'; set it for the {' or the '.join(owners)}")


def _check_same(file: Path, name: str, of_node: Mapping[str, Any], remedy: str = ": set it in a section '/**'") -> None:
    if len(set(of_node.values())) > 1:
        listed = ", ".join(f"{value} for the {node}" for node, value in of_node.items())
        raise SettingsError(f"{file}: {name} = {listed}; expected the same for all of them{remedy}")


def _check_together(file: Path, settings: Mapping[str, Any], arm: Arm, period: float, started: tuple[str, ...]) -> None:
    """Check what no node can check of its own values, or only once it runs."""
    # Not before the values are known to be right: it loads the arm's model.
    from contact_reach_ros.control.stability import check_gains

    try:
        own = settings["controller"]
        check_gains(arm, own["impedance"], period, own["limits"].torque_delay)
        if "driver" in started:
            check_period(period)
    except SettingsError as error:
        raise SettingsError(f"{file}: {error}") from error
    if "adapter" in started:
        of_node = {
            "adapter": settings["adapter"][""].gravity_compensation,
            "controller (supervision.gravity_compensation)": settings["controller"]["supervision"].gravity_compensation,
        }
        _check_same(file, "gravity_compensation", of_node, "")
    load_budget(settings["observer"][""].contact_budget).resolve(arm)
