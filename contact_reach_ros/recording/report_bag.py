"""What a report says about one bag: signals, numbers, and what is missing."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.speed_limit import least_duration
from contact_reach_ros.recording.bag_reader import BagReader
from contact_reach_ros.recording.recompute import Other, Rerun
from contact_reach_ros.recording.recorded_inputs import RecordedInputs
from contact_reach_ros.recording.reexecution import reexecute
from contact_reach_ros.recording.signals import EpisodeSignals, Event, read_signals
from contact_reach_ros.recording.summary import ERROR_LEVEL, Episode, EpisodeSummary
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings
from contact_reach_ros.timing import PERCENTILES
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

CALLED = "stop service called"
"""Reason of a stop that nobody has to worry about: it ends a run."""

_EXPECTED = {
    "joint_states": "joint positions, distance, tick jitter",
    "effort_controller/commands": "commanded torques, round trip",
    "external_torque": "external torque",
    "sim/contacts": "true contact force, which only a simulation knows",
    "safety_state": "safety events",
    "goal_pose": "goal, distance, verdict",
    "reference/pose": "plan age",
    "plan/statistics": "solve time, stop reasons and cost of each plan",
    "intake/controller": "round trip of each tick, and re-execution",
    "settings": "limits, thresholds and configuration",
}


@dataclasses.dataclass(frozen=True)
class ReportBag:
    """One bag, read for a report.

    Attributes
    ----------
    label :
        What the page calls it.
    reader, signals :
        The bag, and what it tells.
    episode, summary :
        None without a goal.
    zero :
        Time of the signals that the page counts from: when the goal was sent, or the first joint state, s.
    end :
        When the run ended, before the stack was shut down, s.
    verdict :
        In a few words; `good` whether it is one.
    budget, torque_limits :
        What the thresholds were, and the cap of each joint's torque, (7,), Nm.
    reruns :
        Controller and observer with other settings, by name; empty without.
    notes :
        What is missing or odd, one sentence each.
    """

    label: str
    reader: BagReader
    signals: EpisodeSignals
    episode: Episode | None
    summary: EpisodeSummary | None
    zero: float
    end: float
    verdict: str
    good: bool
    budget: ContactBudget
    torque_limits: Array
    reruns: Mapping[str, Rerun]
    notes: tuple[str, ...]

    @property
    def path(self) -> Path:
        """Where the bag is."""
        return self.reader.summary.path

    @property
    def stops(self) -> list[Event]:
        """Changes to a stop, up to the end of the run."""
        return [event for event in self.signals.safety if event.level >= ERROR_LEVEL and event.time <= self.end]

    def jitter_us(self) -> Array:
        """Deviation of each tick from 1 ms after the one before, by when joint states were sent, µs."""
        return (np.diff(self.signals.state_sent_ns) - 1_000_000) / 1000.0

    def round_trip_us(self) -> Array:
        """From the sending of a joint state to that of its command, µs."""
        return self.signals.answers_ns / 1000.0


def read_report_bag(path: Path, label: str, other: Other) -> ReportBag:
    """Read a bag, whatever it holds.

    Raises
    ------
    BagError
        If it is none.
    """
    reader = BagReader(path)
    signals = read_signals(reader)
    notes = list(reader.notes)
    if not reader.summary.message_count:
        notes.append("the bag has no messages")
    lost = reader.summary.custom_data.get("messages_lost", "0")
    if lost.isdigit() and int(lost):
        notes.append(f"{lost} messages were lost while the bag was recorded")
    lacking = [
        f"topic {topic} is missing: no {what}"
        for topic, what in _EXPECTED.items()
        if f"/{topic}" not in reader.topics()
    ]
    notes += [*lacking, *signals.notes]
    budget = _section(signals, "observer", "budget", ContactBudget, load_budget(), notes)
    limits = _section(signals, "controller", "limits", LimitSettings, LimitSettings(), notes)
    calls = [event.time for event in signals.safety if event.message == CALLED]
    last = float(signals.position.time[-1]) if len(signals.position.time) else 0.0
    end = min([*calls[:1], last])
    episode = _episode(reader, signals, end, notes)
    summary = episode.summary() if episode is not None else None
    verdict, good = _verdict(signals, summary, end)
    reruns: Mapping[str, Rerun] = {}
    if other:
        try:
            reruns = reexecute(RecordedInputs(reader), other)
        except BagError as error:
            notes.append(f"not executed with other settings: {error}")
    return ReportBag(
        label=label,
        reader=reader,
        signals=signals,
        episode=episode,
        summary=summary,
        zero=episode.start if episode is not None else 0.0,
        end=end,
        verdict=verdict,
        good=good,
        budget=budget,
        torque_limits=limits.torque_share * np.array(iiwa14.TORQUE_LIMITS),
        reruns=reruns,
        notes=tuple(dict.fromkeys(notes)),
    )


def metrics(bag: ReportBag) -> dict[str, tuple[float, str]]:
    """The numbers of the summary with their units, by what they are called; NaN for what is not known."""
    summary, signals = bag.summary, bag.signals
    nan = float("nan")
    found: dict[str, tuple[float, str]] = {
        "time to the goal": (summary.duration_s if summary else nan, "s"),
        "time, over the least possible": (summary.time_ratio if summary else nan, "×"),
        "distance at the end": (1000 * summary.final_error_m if summary else nan, "mm"),
        "way to the goal": (1000 * summary.distance_m if summary else nan, "mm"),
        "largest contact force": (_largest(_until(bag, signals.contact_force, "max")), "N"),
        "time above the permitted force": (_time_above(bag), "ms"),
        "largest external torque": (_largest(np.abs(_until(bag, signals.external_torque))), "Nm"),
        "of what stops the arm": (100 * _largest(threshold_share(bag)), "%"),
        "largest command, of its limit": (100 * _largest(np.abs(signals.command.values) / bag.torque_limits), "%"),
        "ticks": (float(len(signals.position.time)), ""),
        "ticks missed": (summary.missed_ticks if summary else nan, ""),
    }
    for name, values in (("tick jitter", np.abs(bag.jitter_us())), ("round trip", bag.round_trip_us())):
        for key in ("p50", "p99", "p999"):
            percent = PERCENTILES[key]
            found[f"{name} {_percent(percent)}"] = (float(np.percentile(values, percent)) if len(values) else nan, "µs")
    solve = np.array([plan.numbers.get("took ms", nan) for plan in signals.plans])
    found["plans"] = (float(len(signals.plan_times)), "")
    for percent in (50.0, 95.0, 100.0):
        found[f"plan takes {_percent(percent)}"] = (float(np.percentile(solve, percent)) if len(solve) else nan, "ms")
    found["greatest plan age"] = (summary.plan_age_ms_max if summary else nan, "ms")
    return found


def threshold_share(bag: ReportBag) -> Array:
    """(n,) greatest share of any joint's external torque in the threshold that stops the arm at its speed."""
    torque, velocity = bag.signals.external_torque, bag.signals.velocity
    if not len(torque.time):
        return np.zeros(0)
    thresholds = np.tile(np.array(bag.budget.torque_thresholds), (len(torque.time), 1))
    if len(velocity.time):
        row = np.clip(np.searchsorted(velocity.time, torque.time), 0, len(velocity.time) - 1)
        thresholds += np.array(bag.budget.torque_per_speed) * np.abs(np.nan_to_num(velocity.values[row]))
    return _row_maximum(np.abs(torque.values) / thresholds)


def as_json(bag: ReportBag) -> dict[str, Any]:
    """Everything in numbers, for machines; None for what is not known."""
    return {
        "bag": str(bag.path),
        "verdict": bag.verdict,
        "good": bag.good,
        "summary": None if bag.summary is None else bag.summary.as_json(),
        "metrics": {
            name: {"value": value if np.isfinite(value) else None, "unit": unit}
            for name, (value, unit) in metrics(bag).items()
        },
        "events": [
            {"time_s": event.time - bag.zero, "level": event.level, "source": event.name, "message": event.message}
            for event in bag.signals.safety
        ],
        "plan_stop_reasons": stop_reasons(bag),
        "topics": {name: topic.message_count for name, topic in sorted(bag.reader.topics().items())},
        "custom_data": dict(bag.reader.summary.custom_data),
        "settings": {node: dict(values) for node, values in bag.signals.settings.items()},
        "notes": list(bag.notes),
    }


def stop_reasons(bag: ReportBag) -> dict[str, int]:
    """How often each reason ended the search for a plan."""
    reasons = [plan.stop_reason for plan in bag.signals.plans]
    return {reason: reasons.count(reason) for reason in sorted(set(reasons))}


def _section(
    signals: EpisodeSignals, node: str, prefix: str, kind: type[Settings], default: Any, notes: list[str]
) -> Any:
    told = signals.settings.get(node, {})
    values = {
        entry.name: told[f"{prefix}.{entry.name}"] for entry in kind.declared() if f"{prefix}.{entry.name}" in told
    }
    if not values:
        notes.append(f"the bag does not tell the {prefix} of the {node}: that of the package is assumed")
        return default
    try:
        return kind.from_mapping(values, f"settings of the {node}")
    except SettingsError as error:
        notes.append(f"the {prefix} of the {node} cannot be used: {error}")
        return default


def _episode(reader: BagReader, signals: EpisodeSignals, end: float, notes: list[str]) -> Episode | None:
    least = functools.partial(
        least_duration,
        planning=_section(signals, "planner", "planning", PlanningSettings, PlanningSettings(), []),
        impedance=_section(signals, "controller", "impedance", ImpedanceSettings, ImpedanceSettings(), []),
    )
    end_ns = signals.origin_ns + round(end * NANOSECONDS)
    if not len(signals.position.time) or np.isnan(signals.position.values).all():
        return None
    try:
        return Episode(reader, least, end_ns, signals)
    except BagError as error:
        notes.append(f"no verdict: {error}")
        return None


def _verdict(signals: EpisodeSignals, summary: EpisodeSummary | None, end: float) -> tuple[str, bool]:
    stops = [event for event in signals.safety if event.level >= ERROR_LEVEL and event.time < end]
    stops = [event for event in stops if event.message != CALLED]
    if stops:
        return f"stopped by the {stops[0].name}: {stops[0].message}", False
    if summary is None:
        return "no goal in the bag", False
    return ("goal reached", True) if summary.reached else ("goal not reached", False)


def _until(bag: ReportBag, series: Any, column: str | None = None) -> Array:
    """Values from the goal to the end of the run."""
    inside = (series.time >= bag.zero) & (series.time <= bag.end)
    return (series.values if column is None else series.column(column))[inside]


def _time_above(bag: ReportBag) -> float:
    """Milliseconds with a contact force above the permitted one; NaN without any force."""
    force = bag.signals.contact_force
    if len(force.time) < 2:
        return float("nan")
    above = force.column("max")[:-1] > bag.budget.permitted_force
    return 1000 * float(np.diff(force.time)[above].sum())


def _row_maximum(values: Array) -> Array:
    """(n,) of (n, k), NaN only where all are."""
    filled = np.where(np.isnan(values), -np.inf, values).max(axis=1)
    return np.where(np.isinf(filled), np.nan, filled)


def _largest(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else float("nan")


def _percent(percent: float) -> str:
    return "at most" if percent == 100.0 else f"p{percent:g}"
