"""The arms that come with the package, one table each, and those that users bring."""

from __future__ import annotations

import functools
import importlib
from pathlib import Path
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.table import arm_of_table, table_of
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import read_yaml

DEFAULT_ARM = "iiwa14"
ROBOT, ROBOT_DIGEST, ROBOT_TABLE = "robot", "robot digest", "robot table"
"""Names under which nodes report their arm."""
EARLIER_DIGESTS = {"fb09104480dee5b5": ("a1afed95948d1e7c", "f4d510c0cfa2a199")}
"""Digests of arms in bags of earlier versions, where rounding errors were part of them, by the present ones."""
ENDINGS = (".urdf", ".yaml", ".yml")
"""Of files that hold arms."""
_FOLDER = Path(__file__).parent
ARMS = tuple(sorted(file.stem for file in _FOLDER.iterdir() if file.suffix in (".py", ".yaml") and file.stem[0] != "_"))
"""Names that `load_arm` takes: those of the tables in this folder."""


@functools.cache
def load_arm(name: str = DEFAULT_ARM) -> Arm:
    """Load an arm by its name, or from a file; each call returns the same object.

    Parameters
    ----------
    name
        One of `ARMS`, or the path of a URDF, of the YAML file beside it, or of a table, see docs/arms.md.

    Raises
    ------
    SettingsError
        If there is no such arm, with the names of those that there are; or as `read_arm_file`.
    """
    if name.endswith(ENDINGS):
        # It loads what reads meshes, which the arms of the package do without.
        from contact_reach_ros.arm.arm_file import read_arm_file

        return read_arm_file(Path(name)).arm
    if name not in ARMS:
        names = ", ".join(ARMS)
        raise SettingsError(f"arm '{name}' is unknown; expected one of {names}, or the path of a URDF or YAML file")
    if (table := _FOLDER / f"{name}.yaml").is_file():
        return arm_of_table(read_yaml(table), str(table))
    arm: Arm = importlib.import_module(f"{__name__}.{name}").ARM
    return arm


def is_shipped(arm: Arm) -> bool:
    """Whether `load_arm` finds this arm by its name."""
    return arm.name in ARMS and load_arm(arm.name) == arm


def arm_settings(arm: Arm) -> dict[str, Any]:
    """What nodes report of their arm: name and digest, and all of its numbers if the package does not have it."""
    settings: dict[str, Any] = {ROBOT: arm.name, ROBOT_DIGEST: arm.digest}
    return settings if is_shipped(arm) else settings | {ROBOT_TABLE: table_of(arm)}
