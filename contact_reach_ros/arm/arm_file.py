"""Arms in files: a table with all numbers, or a URDF with the few choices that it leaves open."""

from __future__ import annotations

from pathlib import Path

from contact_reach_ros.arm.arm_options import ArmOptions
from contact_reach_ros.arm.table import arm_of_table, converted
from contact_reach_ros.arm.urdf_reader import Reading, read_arm
from contact_reach_ros.settings import read_yaml

_YAML = (".yaml", ".yml")
_OF_TABLES = "joints"
"""Key that only a table has."""


def read_arm_file(file: Path) -> Reading:
    """Read an arm from a table, a URDF, or the options of a URDF.

    Options are in a YAML file beside the URDF, by default of the same name.

    Raises
    ------
    SettingsError
        If the file cannot be read, has an unknown key, or is not the description of a serial arm; the message names
        file and key.
    """
    if file.suffix == ".urdf":
        beside = next((file.with_suffix(ending) for ending in _YAML if file.with_suffix(ending).is_file()), None)
        options = ArmOptions() if beside is None else converted(read_yaml(beside), ArmOptions, str(beside))
        return read_arm(file, options)
    content = read_yaml(file)
    if _OF_TABLES in content:
        return Reading(arm_of_table(content, str(file)), {}, [], [])
    options = converted(content, ArmOptions, str(file))
    return read_arm(file.parent / options.urdf if options.urdf else file.with_suffix(".urdf"), options)
