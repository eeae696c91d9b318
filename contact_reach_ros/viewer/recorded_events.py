"""What happened in a bag that is worth jumping to."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from contact_reach_ros.bags.signals import Event as SafetyEvent
from contact_reach_ros.bags.signals import Series
from contact_reach_ros.messages.cdr import text_at
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


def speaker(data: bytes) -> str:
    """The name in a serialised DiagnosticStatus; there may be tens of thousands."""
    try:
        return text_at(data, 8)
    except (struct.error, UnicodeDecodeError):
        return ""


def goal_events(goals: Series, kind: str, words: str) -> Iterator[Event]:
    """Goals (n, 3), m."""
    for time, position in zip(goals.time.tolist(), goals.values, strict=True):
        yield Event(time, kind, f"{words} {np.round(position, 3).tolist()} m")


def stop_events(states: Sequence[SafetyEvent], begin: float) -> Iterator[Event]:
    """Stops and releases, of safety states at times that count from `begin`, s."""
    stopped: dict[str, bool] = {}
    for state in states:
        if state.is_stop != stopped.get(state.name, False):
            stopped[state.name] = state.is_stop
            yield Event(state.time - begin, "stop" if state.is_stop else "released", f"{state.name}: {state.message}")


def contact_events(forces: Series, states: Sequence[SafetyEvent], begin: float) -> Iterator[Event]:
    """Beginnings of contacts by true forces, N; where there are none by safety states, with times as `stop_events`."""
    if len(forces.time):
        touched = forces.time[forces.column("max") >= _CONTACT_FORCE]
    else:
        touched = np.array([state.time - begin for state in states if state.level == SafetyLevel.CONTACT.value])
    starts = touched[np.append(True, np.diff(touched) > _CONTACT_PAUSE)[: len(touched)]]
    for time in starts.tolist():
        yield Event(time, "contact", "contact begins")
