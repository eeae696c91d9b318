"""The arms that come with the package, one table each, those that users bring, and the parameters that choose one."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.table import arm_of_table, table_of
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import (
    EVERY_NODE,
    Sections,
    Setting,
    check_values,
    declared_parameters,
    full_name,
    read_yaml,
)
from contact_reach_ros.settings import ROBOT as ROBOT_PARAMETER

_log = logging.getLogger(__name__)

DEFAULT_ARM = str(ROBOT_PARAMETER.default)
ROBOT, ROBOT_DIGEST, ROBOT_TABLE = "robot", "robot digest", "robot table"
"""Names under which nodes report their arm."""
EARLIER_DIGESTS = {"b9910d2d7c624b0e": ("fb09104480dee5b5", "a1afed95948d1e7c", "f4d510c0cfa2a199")}
"""Digests that arms had in bags of earlier versions, which told 0 from 0.0, by the present ones."""
ENDINGS = (".urdf", ".xacro", ".xml", ".yaml", ".yml")
"""Of files that hold arms."""
_FOLDER = Path(__file__).parent
ARMS = tuple(sorted(file.stem for file in _FOLDER.glob("*.yaml")))
"""Names that `load_arm` takes: those of the tables in this folder."""
TOOL = "tool"
EVERY_SECTION: Sections = {TOOL: Tool}
"""Settings of every node by prefix: all of them have the same arm."""
TOOL_PARAMETERS = tuple(full_name(TOOL, entry.name) for entry in Tool.declared())


def load_arm(name: str = DEFAULT_ARM) -> Arm:
    """Load an arm by its name, or from a file; each call returns the same object.

    Raises `SettingsError` if there is no such arm, with the names of those that there are; or as `read_arm_file`.

    Parameters
    ----------
    name
        One of `ARMS`, or the path of a URDF, xacro or MJCF file, of the YAML file beside it, or of a table, see
        docs/arms.md.
    """
    # Also the same object for the default and its name.
    return _load(name)


@functools.cache
def _load(name: str) -> Arm:
    if name.lower().endswith(ENDINGS):
        # It loads what reads meshes, which the arms of the package do without.
        from contact_reach_ros.arm.urdf_reader import read_arm_file

        reading = read_arm_file(Path(name))
        for line in reading.doubts:
            _log.warning("%s: %s", name, line)
        return reading.arm
    if name not in ARMS:
        names = ", ".join(ARMS)
        raise SettingsError(
            f"arm '{name}' is unknown; expected one of {names}, or the path of a URDF, xacro, MJCF or YAML file"
        )
    table = _FOLDER / f"{name}.yaml"
    return arm_of_table(read_yaml(table), str(table))


def is_shipped(arm: Arm) -> bool:
    """Whether `load_arm` finds this arm by its name."""
    return arm.name in ARMS and load_arm(arm.name) == arm


def arm_settings(arm: Arm) -> dict[str, Any]:
    """What nodes report of their arm: name and digest, and all of its numbers if the package does not have it."""
    settings: dict[str, Any] = {ROBOT: arm.name, ROBOT_DIGEST: arm.digest}
    return settings if is_shipped(arm) else settings | {ROBOT_TABLE: table_of(arm)}


def known_parameters(sections: Sections, arm: Arm) -> dict[str, Setting]:
    """The parameters of a node with these sections, and those of every node, by full name."""
    return {entry.name: entry for entry in EVERY_NODE} | declared_parameters({**EVERY_SECTION, **sections}, arm)


def make_settings(values: Mapping[str, Any], sections: Sections, arm: Arm, source: str) -> dict[str, Any]:
    """The settings objects of a node by prefix, out of its parameters by full name.

    Raises `SettingsError`, naming `source` and the parameter, if the node has no such parameter, a value is not
    accepted, or two do not go together.
    """
    checked = check_values(values, known_parameters(sections, arm), source)
    made: dict[str, Any] = {}
    for prefix, settings in sections.items():
        names = {entry.name: full_name(prefix, entry.name) for entry in settings.declared()}
        own: dict[str, Any] = {name: checked[full] for name, full in names.items() if full in checked}
        try:
            made[prefix] = settings(**own).resolve(arm)
        except SettingsError as error:
            raise SettingsError(f"{source}: {error}") from error
    return made


def arm_in(values: Mapping[str, Any], source: str) -> Arm:
    """The arm of a node, with its tool, out of parameters by full name; all others are left alone.

    Raises `SettingsError`, naming `source`, if there is no such arm or tool.
    """
    if ROBOT_TABLE in values:
        # As nodes report an arm that the package does not have.
        arm = arm_of_table(values[ROBOT_TABLE], f"{source}: {ROBOT_TABLE}")
    else:
        where = f"{source}: {ROBOT}"
        name = str(ROBOT_PARAMETER.check(values.get(ROBOT, DEFAULT_ARM), where))
        try:
            arm = load_arm(name)
        except SettingsError as error:
            raise SettingsError(f"{where}: {error}") from error
    tool = {name: values[name] for name in TOOL_PARAMETERS if name in values}
    return arm.with_tool(make_settings(tool, EVERY_SECTION, arm, source)[TOOL])
