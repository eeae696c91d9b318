"""The arm that was recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.parameter_files import arm_in

_FIRST_ARM = "iiwa14"
"""The arm of bags that name none."""


def recorded_arm(settings: Mapping[str, Mapping[str, Any]]) -> Arm:
    """The arm that the nodes of a bag had, with its tool.

    Raises
    ------
    BagError
        If this version does not have it, or has another one of that name.
    """
    found: Arm | None = None
    for node, values in settings.items():
        try:
            arm = arm_in({"robot": _FIRST_ARM, **values}, f"settings of the {node}")
        except SettingsError as error:
            raise BagError(str(error)) from error
        digest = values.get("robot digest", arm.digest)
        if digest != arm.digest:
            raise BagError(
                f"settings of the {node}: the arm '{arm.name}' had digest {digest}, this version's has {arm.digest}; "
                "use the version that recorded the bag"
            )
        found = found or arm
    return found or load_arm(_FIRST_ARM)
