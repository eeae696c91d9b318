"""The arm of a bag, out of the settings that its nodes reported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arms import ROBOT_DIGEST, ROBOT_TABLE, load_arm, reported_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.settings import read_settings

SETTINGS = "settings"


def arm_in(bag: BagReader) -> Arm:
    """The arm that the nodes of a bag had; raises `BagError` as `recorded_arm`."""
    topics = [name for name in (f"/{SETTINGS}",) if name in bag.topics()]
    statuses = [item.message for item in bag.messages(topics)] if topics else []
    return recorded_arm({status.name: read_settings(status) for status in statuses if status is not None})


def recorded_arm(settings: Mapping[str, Mapping[str, Any]]) -> Arm:
    """The arm that nodes had; `settings` are the recorded ones by node.

    Raises
    ------
    BagError
        If this version does not have it, or has another one of that name.
    """
    arm = load_arm()
    for node, values in settings.items():
        try:
            arm = reported_arm(values)
        except SettingsError as error:
            raise BagError(f"settings of the {node}: {error}") from error
        digest = values.get(ROBOT_DIGEST, arm.digest)
        # A table is the arm itself.
        if digest != arm.digest and ROBOT_TABLE not in values:
            raise BagError(
                f"settings of the {node}: the arm '{arm.name}' had digest {digest}, this version's has {arm.digest}; "
                "use the version that recorded the bag"
            )
    return arm
