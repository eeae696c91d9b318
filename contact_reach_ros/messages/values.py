"""Values, joints and settings in messages, of any object with the fields of the message."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.timing import NANOSECONDS

LATEST_S = 2**31 - 3600
"""Seconds of the latest stamp that is accepted: an hour is left for what follows, which has stamps of its own."""

FARTHEST = 1e3
"""Of what is drawn, m."""

GOAL_STAMP, GOAL_PHASE = "goal stamp ns", "phase"
"""Keys of goal/state: the stamp of the goal, and its phase."""

_GOAL = ("goal x m", "goal y m", "goal z m")
"""Keys of a plan's goal in plan/statistics."""


def checked_stamp(seconds: int, nanosec: int, topic: str) -> int:
    """Nanoseconds of a stamp that other stamps are made from.

    Raises `InputError` if it is no time, or too late to add to.
    """
    if not (0 <= seconds <= LATEST_S and nanosec < NANOSECONDS):
        raise InputError(
            f"{topic}: header.stamp = {seconds} s and {nanosec} ns; expected 0 to {LATEST_S} s and less than a second "
            "in ns: see the sender's clock"
        )
    return seconds * NANOSECONDS + nanosec


def nanoseconds(stamp: Any) -> int:
    """Nanoseconds of a stamp or duration."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def vector(message: Any) -> Array:
    """Position or vector (3,) of a Point or Vector3."""
    return np.array([message.x, message.y, message.z])


def quaternion(message: Any) -> Array:
    """Quaternion as (x, y, z, w)."""
    return np.array([message.x, message.y, message.z, message.w])


def split_array(message: Any) -> dict[str, Array]:
    """The parts of a Float64MultiArray whose dimensions name parts one after the other; empty if they do not fit."""
    sizes = [dimension.size for dimension in message.layout.dim]
    data = np.asarray(message.data, dtype=float)
    if not sizes or sum(sizes) != len(data):
        return {}
    names = [dimension.label for dimension in message.layout.dim]
    return dict(zip(names, np.split(data, np.cumsum(sizes)[:-1]), strict=True))


def numbers(status: Any) -> Iterator[tuple[str, float]]:
    """The values of a DiagnosticStatus that are numbers, by their keys."""
    for item in status.values:
        try:
            yield item.key, float(item.value)
        except ValueError:
            continue


def goal_values(position: Array) -> dict[str, float]:
    """The goal of a plan, at `position` (3,), m, for plan/statistics."""
    return dict(zip(_GOAL, position.tolist(), strict=True))


def goal_in(values: Mapping[str, float]) -> Array | None:
    """The goal (3,), m, among the numbers of a plan; None in bags of earlier versions."""
    return np.array([values[key] for key in _GOAL]) if all(key in values for key in _GOAL) else None


def places_of(joints: Sequence[str], names: Sequence[str], topic: str) -> NDArray[np.intp]:
    """Where the wanted joints stand among the names in a message, whose order may be any.

    Raises `InputError` if joints are missing, or there twice; topic, field and names are given.
    """
    missing = [joint for joint in joints if joint not in names]
    if missing:
        found = ", ".join(names) or "no name"
        raise InputError(
            f"{topic}: field name lacks {', '.join(missing)}: it has {found}; expected all of {', '.join(joints)}"
        )
    twice = [joint for joint in joints if names.count(joint) > 1]
    if twice:
        raise InputError(f"{topic}: field name has {', '.join(twice)} more than once; expected each joint once")
    return np.array([names.index(joint) for joint in joints], np.intp)


def efforts(message: Any, topic: str) -> dict[str, float]:
    """The efforts of a JointState by name; raises `InputError` if there is not one for each name."""
    if len(message.effort) != len(message.name):
        raise InputError(
            f"{topic}: effort has {len(message.effort)} values; expected one for each of {len(message.name)} names"
        )
    return dict(zip(message.name, message.effort, strict=True))


def read_settings(status: Any) -> dict[str, Any]:
    """The values of a message on topic `settings`; one that is no JSON stays text."""
    values: dict[str, Any] = {}
    for entry in status.values:
        try:
            values[entry.key] = json.loads(entry.value)
        except ValueError:
            values[entry.key] = entry.value
    return values
