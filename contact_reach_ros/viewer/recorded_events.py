"""What happened in a bag that is worth jumping to."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.messages.cdr import after_string, text_at
from contact_reach_ros.viewer.frame import SafetyLevel

_CONTACT_FORCE = 0.5
"""True force that counts as a contact, N."""
_CONTACT_PAUSE = 0.3
"""Time without contact after which the next contact is a new one, s."""


class Event(NamedTuple):
    """Something worth jumping to: time, s, a kind, and a description.

    Kinds are 'goal', 'refused' (a goal without a plan), 'contact', 'stop' and 'released'.
    """

    time: float
    kind: str
    text: str


class Reported(NamedTuple):
    """A safety state without its values."""

    name: str
    level: SafetyLevel
    message: str


def read_reported(data: bytes) -> Reported:
    """Read the needed parts of a serialised DiagnosticStatus; there may be tens of thousands."""
    try:
        name, message = text_at(data, 8), text_at(data, after_string(data, 8))
    except (struct.error, UnicodeDecodeError):
        name = message = ""
    level = SafetyLevel(min(data[4], SafetyLevel.STOP.value)) if len(data) > 4 else SafetyLevel.OK
    return Reported(name, level, message)


def goal_events(times: Array, positions: Array, kind: str, words: str) -> Iterator[Event]:
    """Goals (n, 3), m, at their times, s."""
    for time, position in zip(times.tolist(), positions, strict=True):
        yield Event(time, kind, f"{words} {np.round(position, 3).tolist()} m")


def stop_events(times: Array, reported: Sequence[Reported]) -> Iterator[Event]:
    """Stops and releases, of safety states at their times, s."""
    stopped: dict[str, bool] = {}
    for time, entry in zip(times.tolist(), reported, strict=True):
        is_stop = entry.level is SafetyLevel.STOP
        if is_stop != stopped.get(entry.name, False):
            stopped[entry.name] = is_stop
            yield Event(time, "stop" if is_stop else "released", f"{entry.name}: {entry.message}")


def contact_events(times: Array, forces: Array, reported_at: Array, reported: Sequence[Reported]) -> Iterator[Event]:
    """Beginnings of contacts by true forces, N, at their times, s; where there are none by safety states."""
    if len(times):
        touched = times[forces >= _CONTACT_FORCE]
    else:
        touched = reported_at[[entry.level is SafetyLevel.CONTACT for entry in reported]]
    starts = touched[np.append(True, np.diff(touched) > _CONTACT_PAUSE)[: len(touched)]]
    for time in starts.tolist():
        yield Event(time, "contact", "contact begins")
