"""Schedules of faults as text."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Setting, unknown_key
from contact_reach_ros.simulation.fault_kinds import Fault, Schedule, Seam, fault_kinds


def parse_faults(text: str, arm: Arm) -> Schedule:
    """Parse a schedule such as ``push link=lbr_link_4 force="0 50 0" at=2 for=0.1; drop_commands share=0.3``.

    Parameters
    ----------
    text
        Faults separated by semicolons, each a kind and its keys. An empty text is an empty schedule.
    arm
        Arm with the joints and links that faults may name.

    Raises
    ------
    SettingsError
        On an unknown kind or key, or a value that is not accepted; the message names fault and key.
    """
    faults = []
    for number, part in enumerate((part.strip() for part in text.split(";")), 1):
        if not part:
            continue
        source = f"fault {number}"
        try:
            kind, *pairs = shlex.split(part)
        except ValueError as error:
            raise SettingsError(f"{source}, '{part}': {error}; expected 'kind key=value ...'") from error
        values: dict[str, str] = {}
        for pair in pairs:
            key, equals, value = pair.partition("=")
            if not equals:
                raise SettingsError(f"{source}, '{pair}': expected key=value, quoted if the value holds blanks")
            if key in values:
                raise SettingsError(f"{source}: {key} is given twice")
            values[key] = value
        faults.append(_make(kind, values, arm, source))
    return tuple(faults)


def driver_faults(text: str, arm: Arm) -> Schedule:
    """Parse a schedule, as `parse_faults`, of faults that the driver can play.

    Raises `SettingsError` if the text is not a schedule, or has a fault of another node.
    """
    schedule = parse_faults(text, arm)
    for fault in schedule:
        if fault.kind.seam is Seam.NODES:
            raise SettingsError(
                f"faults: the driver cannot play {fault.name}; freeze or kill the node: "
                "ros2 run contact_reach_ros faults freeze planner"
            )
    return schedule


def _make(name: str, values: Mapping[str, str], arm: Arm, source: str) -> Fault:
    kinds = fault_kinds(arm)
    if name not in kinds:
        raise SettingsError(unknown_key(name, kinds, source).replace("unknown key", "unknown kind"))
    keys = kinds[name].keys
    made = {key.name: key.default for key in keys.values()}
    for key, value in values.items():
        if key not in keys:
            raise SettingsError(unknown_key(key, keys, f"{source}, {name}"))
        made[key] = keys[key].check(_from_text(value, keys[key]), f"{source}, {name}: {key}")
    return Fault(kinds[name], made)


def _from_text(value: str, key: Setting) -> Any:
    """Convert the text of a number or list; text that cannot be converted is returned as is, for `check` to refuse."""
    if key.kind is not float:
        return value
    try:
        numbers = [float(word) for word in value.split()]
    except ValueError:
        return value
    if key.length is not None:
        return numbers
    return numbers[0] if len(numbers) == 1 else value
