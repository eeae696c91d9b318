"""Parameters of ROS nodes, and the files with them, without ROS."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.table import arm_of_table
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import DEFAULT_ARM, ROBOT_TABLE, load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Sections, Setting, read_yaml, unknown_key
from contact_reach_ros.timing import PERIOD

DEFAULT_PARAMETERS = "default.yaml"
"""File in `config/` with the parameters to use unless the user names another."""

NODES = {
    "driver": "Simulates the arm: publishes its joint states and takes torques, in real time or in lockstep.",
    "controller": "Answers every joint state with one torque command.",
    "observer": "Estimates external torques, reports contact and stops the arm above the contact budget.",
    "planner": "Turns goals into paired references, re-planned continuously.",
    "adapter": "Passes commands on to the drive, and watches over them for a drive that does not.",
    "recorder": "Records the topics of the stack into a bag until it is ended.",
    "viewer": "Serves a browser page that shows the running stack, or a bag.",
    "bringup": "Starts the stack, supervises it, and ends it so that the arm comes to rest.",
}
"""The nodes that have parameters, and what each does."""

ROBOT = Setting("robot", DEFAULT_ARM, "arm: a name, or the path of its file", "", None, None, (), None, False)
"""The parameter of every node that says which arm it has; the lengths of other parameters follow from it."""
RATE = Setting("state_rate", 1.0 / PERIOD, "nominal rate of joint states", "Hz", 50.0, 1000.0, (), None, False)
"""The parameter of every node from which gaps, debounces and watchdogs follow."""
AUTOSTART = Setting("autostart", True, "configure and activate itself at its start", "", None, None, (), None, False)
CPUS = Setting("cpus", "auto", "CPUs to run on: auto, all, or numbers", "", None, None, (), None, False)
EVERY_NODE = (ROBOT, RATE, AUTOSTART, CPUS)
"""Parameters of every node but bring-up."""

TOOL = "tool"
EVERY_SECTION: Sections = {TOOL: Tool}
"""Settings of every node by prefix: all of them have the same arm."""
TOOL_PARAMETERS = tuple(f"{TOOL}.{entry.name}" for entry in Tool.declared())

_GAINS = "impedance."
_OF_ROS = ("use_sim_time", "start_type_description_service")


def full_name(prefix: str, name: str) -> str:
    """Name of a parameter, with its prefix if there is one."""
    return f"{prefix}.{name}" if prefix else name


def declared_parameters(sections: Sections, arm: Arm) -> dict[str, Setting]:
    """The parameters of a node with these sections, by full name."""
    return {
        full_name(prefix, entry.name): entry.for_arm(arm)
        for prefix, settings in sections.items()
        for entry in settings.declared()
    }


def known_parameters(sections: Sections, arm: Arm) -> dict[str, Setting]:
    """The parameters of a node with these sections, and those of every node, by full name."""
    return {entry.name: entry for entry in EVERY_NODE} | declared_parameters({**EVERY_SECTION, **sections}, arm)


def arm_in(values: Mapping[str, Any], source: str) -> Arm:
    """The arm of a node, with its tool, out of parameters by full name; names of others are left alone.

    Raises
    ------
    SettingsError
        Naming `source`, if there is no such arm or tool.
    """
    if ROBOT_TABLE in values:
        # As nodes report an arm that the package does not have.
        arm = arm_of_table(values[ROBOT_TABLE], f"{source}: {ROBOT_TABLE}")
    else:
        arm = checked_arm(values.get(ROBOT.name, ROBOT.default), f"{source}: {ROBOT.name}")
    return arm.with_tool(make_settings(values, EVERY_SECTION, arm, source)[TOOL])


def check_name(known: Mapping[str, Setting], name: str, source: str) -> None:
    """Check that a node has a parameter, among those of `known_parameters` and ROS's own.

    Raises
    ------
    SettingsError
        Naming `source` and the parameter, and the nearest that there is.
    """
    if name not in known and name not in _OF_ROS and not name.startswith("qos_overrides."):
        if name.startswith(_GAINS) and not any(other.startswith(_GAINS) for other in known):
            hint = "set it for the controller, where the planner reads it, too"
            raise SettingsError(f"{source}: unknown key '{name}'; {hint}")
        raise SettingsError(unknown_key(name, known, source))


def check_parameters_in(file: Path, node_name: str, known: Mapping[str, Setting]) -> None:
    """Check the parameters in a file that concern a node, one by one; `known` are those of `known_parameters`.

    Raises
    ------
    SettingsError
        Naming file, node and parameter, and what is accepted.
    """
    source = f"{file}: {node_name}"
    for name, value in parameters_in(file, node_name).items():
        check_name(known, name, source)
        if name in known:
            known[name].check(value, f"{source}: {name}")


def make_settings(values: Mapping[str, Any], sections: Sections, arm: Arm, source: str) -> dict[str, Any]:
    """The settings objects of a node by prefix, out of values by full name; names of others are left alone.

    Raises
    ------
    SettingsError
        Naming `source`, if a value is not accepted, or two do not go together.
    """
    made: dict[str, Any] = {}
    for prefix, settings in sections.items():
        names = {entry.name: full_name(prefix, entry.name) for entry in settings.declared()}
        own = {name: values[full] for name, full in names.items() if full in values}
        try:
            made[prefix] = settings.from_mapping(own, f"{source}.{prefix}".rstrip(".")).resolve(arm)
        except SettingsError as error:
            raise SettingsError(str(error) if str(error).startswith(source) else f"{source}: {error}") from error
    return made


def check_node_names(file: Path, others: Sequence[str] = ()) -> None:
    """Check that each section of a parameter file is for one of `NODES`, by its wildcards for all, or for `others`.

    Raises
    ------
    SettingsError
        Naming the file and the section, and the nearest node.
    """
    nodes = [*NODES, *others]
    for pattern in read_yaml(file):
        if not any(_is_for(str(pattern), node) for node in nodes):
            raise SettingsError(unknown_key(str(pattern), nodes, str(file), "node"))


def sections_of_others(file: Path, node_name: str) -> list[str]:
    """The sections of a parameter file that are not for this node."""
    return [str(pattern) for pattern in read_yaml(file) if not _is_for(str(pattern), node_name)]


def parameters_in(file: Path, node_name: str) -> dict[str, Any]:
    """Read the parameters in a file that concern a node, flattened to dotted names.

    Raises `SettingsError` if the file cannot be read or is not a parameter file.
    """
    found: dict[str, Any] = {}
    for pattern, content in read_yaml(file).items():
        if not isinstance(content, dict) or "ros__parameters" not in content:
            raise SettingsError(f"{file}: '{pattern}' has no ros__parameters; expected '<node>: ros__parameters: ...'")
        if _is_for(str(pattern), node_name):
            parameters = content["ros__parameters"] or {}
            if not isinstance(parameters, dict):
                raise SettingsError(f"{file}: {pattern}.ros__parameters is not a mapping of keys to values")
            found.update(_flatten(parameters))
    return found


def checked_arm(value: Any, where: str) -> Arm:
    """The arm that a value of the parameter `robot` stands for.

    Raises
    ------
    SettingsError
        Naming `where` it is, if there is no such arm, or its file is refused.
    """
    name = str(ROBOT.check(value, where))
    try:
        return load_arm(name)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def robot_in(file: Path) -> str:
    """The arm of the nodes with this parameter file, as `load_arm` takes it; raises `SettingsError` as above."""
    return str(parameters_in(file, "planner").get(ROBOT.name, ROBOT.default))


def as_arguments(parameters: Mapping[str, Any]) -> list[str]:
    """ROS arguments that set parameters of the one node of a process."""
    # JSON is YAML: quoted, an empty or blank-separated string stays a string.
    pairs = (["-p", f"{name}:={json.dumps(value)}"] for name, value in parameters.items())
    return list(itertools.chain.from_iterable(pairs))


def namespace_arguments(namespace: str, file: Path, node_name: str) -> list[str]:
    """ROS arguments that put a node into a namespace, with what a parameter file has for it; none for the root.

    ROS would ignore the file's sections there, unless they begin with a wildcard, and share one clock.
    """
    if namespace == "/":
        return []
    return ["-r", f"__ns:={namespace}", "-r", "/clock:=clock", *as_arguments(parameters_in(file, node_name))]


def _is_for(pattern: str, node_name: str) -> bool:
    """Whether a section of a parameter file is for a node without a namespace; ** stands for any namespace."""
    *spaces, name = pattern.strip("/").split("/")
    return name in (node_name, "*", "**") and all(space == "**" for space in spaces)


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = full_name(prefix, str(key))
        if isinstance(value, dict):
            flat.update(_flatten(value, name))
        else:
            flat[name] = value
    return flat
