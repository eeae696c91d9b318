"""Checks a parameter file, and what is changed in it, as a whole: before any process starts, and without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.control.adapter_settings import AdapterSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.node_settings import ALL_SECTIONS
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.parameter_files import (
    EVERY_SECTION,
    RATE,
    ROBOT,
    TOOL,
    arm_in,
    check_node_names,
    check_parameters_in,
    full_name,
    known_parameters,
    make_settings,
    parameters_in,
)
from contact_reach_ros.simulation.settings import check_period

_NEEDED = ("controller", "observer", "planner")
_ONE_CLOCK = ("driver", "adapter", *_NEEDED)
"""Nodes that count joint states: they must have the same arm and rate."""

Given = Mapping[str, Mapping[str, Any]]


def check_parameters(file: Path, given: Given | None = None) -> None:
    """Check names of nodes and parameters, values, and what must be the same in several nodes.

    Controller and planner cannot have different gains: both read those of the section `controller`. In the same way the
    controller reads the settings of the observer with which it watches itself.

    Parameters
    ----------
    file
        Parameter file of all nodes.
    given
        Parameters that come on top of the file's, by the nodes that are started; None while nobody knows which are.

    Raises
    ------
    SettingsError
        Naming the file, node and parameter, and what is expected.
    """
    check_node_names(file)
    values: dict[str, dict[str, Any]] = {}
    settings: dict[str, dict[str, Any]] = {}
    arms: dict[str, Arm] = {}
    for node, sections in ALL_SECTIONS.items():
        source = f"{file}: {node}"
        values[node] = own = {**parameters_in(file, node), **(given or {}).get(node, {})}
        arms[node] = arm = arm_in(own, source)
        check_parameters_in(file, node, known_parameters(sections, arm))
        settings[node] = make_settings(own, {**EVERY_SECTION, **sections}, arm, source)
    started = _NEEDED if given is None else tuple(given)
    for name, default in {entry.name: entry.default for entry in (ROBOT, RATE)}.items():
        _check_same(file, name, {node: values[node].get(name, default) for node in _ONE_CLOCK if node in started})
    for entry in Tool.declared():
        of_node = {node: getattr(settings[node][TOOL], entry.name) for node in _ONE_CLOCK if node in started}
        _check_same(file, full_name(TOOL, entry.name), of_node)
    rate: Any = values["controller"].get(RATE.name, RATE.default)
    _check_together(file, settings, arms["controller"], 1.0 / rate, started)


def _check_same(file: Path, name: str, of_node: Mapping[str, Any]) -> None:
    if len(set(of_node.values())) > 1:
        listed = ", ".join(f"{value} for the {node}" for node, value in of_node.items())
        raise SettingsError(f"{file}: {name} = {listed}; expected the same for all of them: set it in a section '/**'")


def _check_together(file: Path, settings: Mapping[str, Any], arm: Arm, period: float, started: tuple[str, ...]) -> None:
    """Check what no node can check of its own values, or only once it runs."""
    # Not before the values are known to be right: it loads the arm's model.
    from contact_reach_ros.control.stability import check_gains

    try:
        check_gains(arm, settings["controller"]["impedance"], period)
        if "adapter" in started:
            adapter: AdapterSettings = settings["adapter"][""]
            adapter.check_period(period)
        if "driver" in started:
            check_period(period)
    except SettingsError as error:
        raise SettingsError(f"{file}: {error}") from error
    paths = {node: settings[node][""].contact_budget for node in ("planner", "observer")}
    planners, observers = (load_budget(path).resolve(arm) for path in paths.values())
    if planners != observers:
        raise SettingsError(f"{file}: planner and observer read different contact budgets: {paths}; expected the same")
