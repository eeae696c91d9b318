"""The arm of a bag, out of the settings that its nodes reported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import EARLIER_DIGESTS, ROBOT_DIGEST, ROBOT_TABLE, arm_in, load_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.values import read_settings

SETTINGS = "settings"
_ONLOOKERS = ("recorder", "viewer")
"""Nodes that may have been started apart from the stack, with another arm."""


def arm_of_bag(bag: BagReader) -> Arm:
    """The arm that the nodes of a bag had, with its last tool; raises `BagError` as `recorded_arm`."""
    statuses = (item.message for item in bag.messages({f"/{SETTINGS}"} & bag.topics().keys()))
    return recorded_arm({status.name: read_settings(status) for status in statuses})


def recorded_arm(settings: Mapping[str, Mapping[str, Any]]) -> Arm:
    """The arm that nodes had, with its tool; `settings` are the recorded ones by node.

    Raises `BagError` if this version does not have it, or has another one of that name.
    """
    found: Arm | None = None
    for node, values in settings.items():
        try:
            arm = arm_in(values, f"settings of the {node}")
        except SettingsError as error:
            raise BagError(str(error)) from error
        digest = values.get(ROBOT_DIGEST, arm.digest)
        # A table is the arm itself.
        is_same = digest == arm.digest or digest in EARLIER_DIGESTS.get(arm.digest, ()) or ROBOT_TABLE in values
        if not is_same:
            raise BagError(
                f"settings of the {node}: the arm '{arm.name}' had digest {digest}, this version's has {arm.digest}; "
                "use the version that recorded the bag"
            )
        if node not in _ONLOOKERS:
            found = found or arm
    return found or load_arm()
