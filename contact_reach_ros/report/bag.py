"""One bag as a report shows it: signals, numbers, and notes on missing data."""

from __future__ import annotations

import shlex
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import (
    COMMANDS,
    EpisodeSignals,
    Series,
    goal_distance,
    read_signals,
    recorded_arm,
    settings_of_bag,
)
from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.errors import BagError
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.reexecution.inputs import BUDGET, recorded_sections
from contact_reach_ros.settings import RATE
from contact_reach_ros.timing import NANOSECONDS

CALLED = "stop service called"
"""Reason of the stop that ends a run as planned."""
BEFORE = 2.0
"""Time shown before the first goal, s: a stack may have waited long for it."""

_EXPECTED = {
    "joint_states": "joint positions, distance, tick jitter",
    "effort_controller/commands": "commanded torques, round trip",
    "external_torque": "external torque",
    "sim/contacts": "true contact force, which only a simulation publishes",
    "safety_state": "safety events",
    "goal_pose": "goal, distance",
    "goal/state": "verdict: whether the arm has settled at the goal",
    "reference/pose": "number of plans, plan age",
    "plan/statistics": "solve time, stop reason and cost of each plan",
    "intake/controller": "round trip of each tick, re-execution",
    "settings": "limits, thresholds and configuration",
}


class ReportBag:
    """One bag, complete or not, read for a report: its episode is that of the first goal, without one the whole bag.

    Raises `BagError` if the file is not a bag.

    Parameters
    ----------
    path :
        The bag.
    label :
        Its name on the page.
    timeout, settle :
        Times after the goal, and after it was reached, at which the episode ends at the latest, s.

    Attributes
    ----------
    arm :
        The recorded arm.
    reader, signals, settings :
        The bag, its signals, and the settings of its nodes.
    has_goal :
        Whether there is a goal.
    zero :
        Begin of the episode, and origin of the page's times: when the goal was sent, or else the first joint state, s
        on the clock of the signals.
    reached :
        When the arm had settled at the goal, as the planner reported, s on the same clock; NaN if it did not.
    end :
        End of the episode, likewise: where the bag ends, or a stop is called.
    distance :
        Distance of the flange from the goal: the column "distance", m; empty without a goal.
    verdict :
        The outcome in a few words.
    good :
        Whether the goal was reached without a stop.
    budget :
        Permitted contact force and torque thresholds.
    torque_limits :
        (n,) limit of each joint's commanded torque, Nm.
    notes :
        Missing or odd data, one sentence each.
    """

    def __init__(self, path: Path, label: str, timeout: float = np.inf, settle: float = np.inf) -> None:
        self.label = label
        self.reader = reader = BagReader(path, of_stack=True)
        notes: list[str] = []
        self.settings = settings = settings_of_bag(reader)
        try:
            self.arm = recorded_arm(settings)
        except BagError as error:
            self.arm = load_arm()
            notes.append(str(error))
        sections: dict[str, Any] = {BUDGET: load_budget(), "limits": LimitSettings()}
        of_settings: list[str] = []
        for node, prefix in (("observer", BUDGET), ("controller", "limits")):
            try:
                if node not in settings:
                    raise BagError("the bag lacks its settings")
                sections[prefix] = recorded_sections(node, settings[node], self.arm, reader.path)[prefix]
            except BagError as error:
                of_settings.append(f"the package's own {prefix} of the {node} is assumed: {error}")
        self.budget: ContactBudget = sections[BUDGET].resolve(self.arm)
        self.torque_limits: Array = sections["limits"].torque_share * self.arm.torque_limits
        self.signals = signals = read_signals(reader, self.arm)
        if not reader.message_count:
            notes.append("the bag has no messages")
        lost = reader.custom_data.get("messages_lost", "0")
        if lost.isdigit() and int(lost):
            notes.append(f"{lost} messages were lost while the bag was recorded")
        # Behind an adapter the controller's own topic may be all there is.
        there = {name for name, topic in reader.topics.items() if topic.message_count}
        there |= {f"/{COMMANDS[-1]}" for name in COMMANDS if f"/{name}" in there}
        missing = [topic for topic in _EXPECTED if f"/{topic}" not in there]
        notes += [f"topic {topic} is missing: no {_EXPECTED[topic]}" for topic in missing]
        # Reading has found some, too.
        notes = [*reader.notes, *notes, *signals.notes, *of_settings]
        calls = [event.time for event in signals.safety if event.message == CALLED]
        # One before the goal ends nothing.
        ends = [time for time in calls if time >= min(signals.goals.time, default=-np.inf)]
        end = min([*ends, max(signals.position.time, default=np.inf)])
        if not np.isfinite(signals.position.values).all(axis=1).any():
            notes.append("no verdict: holds no joint states of the arm; record joint_states")
        self.distance = goal_distance(signals, self.arm)
        self.has_goal = bool(len(self.distance.time))
        self.zero = float(signals.goals.time[0]) if self.has_goal else 0.0
        last = min(end, self.zero + timeout)
        settled = signals.settled[(signals.settled >= self.zero) & (signals.settled <= last)]
        self.reached = float(settled[0]) if self.has_goal and len(settled) else float("nan")
        self.end = float(np.fmin(last, self.reached + settle))
        self.verdict, self.good = self._verdict(end, is_known="/goal/state" in there)
        self.notes = tuple(dict.fromkeys(notes))

    @property
    def path(self) -> Path:
        """Path of the bag."""
        return self.reader.path

    @property
    def quoted_path(self) -> str:
        """Path of the bag for a shell."""
        return shlex.quote(str(self.path))

    @property
    def origin(self) -> str:
        """Where the bag comes from, in a few words: scene, seed, kind of time and number of messages."""
        kept = self.reader.custom_data
        words = [f"{key} {kept[key]}" for key in ("scene", "seed") if key in kept]
        words.append("simulated time" if "/clock" in self.reader.topics else "real time")
        words.append(f"{self.reader.message_count} messages")
        words += [f"{kept['messages_lost']} lost"] if "messages_lost" in kept else []
        return ", ".join(words)

    @property
    def shown_from(self) -> float:
        """Start of the time range that charts show at first, s on the page."""
        return -min(BEFORE, self.zero)

    def _verdict(self, end: float, is_known: bool) -> tuple[str, bool]:
        """The outcome, and whether it is good; `end` is that of the bag, and goals' states are known or not."""
        start, safety = self.zero if self.has_goal else -np.inf, self.signals.safety
        # One that was released before the goal ends nothing.
        held = {event.name: event for event in safety if event.time < start}
        events = [*held.values(), *(event for event in safety if start <= event.time < end)]
        stop = next((event for event in events if event.is_stop), None)
        if stop is not None:
            return f"stopped by the {stop.name}: {stop.message}", False
        if not self.has_goal:
            return "no goal in the bag", False
        if not is_known:
            return "unknown: the bag lacks goal/state", False
        return ("goal not reached", False) if np.isnan(self.reached) else ("goal reached", True)


def metrics(bag: ReportBag) -> dict[str, tuple[float, str]]:
    """The numbers of the report with their units, by name; NaN where unknown. Those of the episode count to its end."""
    signals, end = bag.signals, bag.end
    ticks = signals.position.time[signals.position.time <= end]
    contact, torque = (series.between(bag.zero, end) for series in (signals.contact_force, signals.external_torque))
    missed = signals.missed_ticks.between(-np.inf, end).values
    took = signals.plans.between(-np.inf, end).column("took ms")
    # Deviation of each tick from its time after the one before.
    rate = bag.settings.get("driver", {}).get(RATE.name, RATE.default)
    period_ns = NANOSECONDS / rate if isinstance(rate, (int, float)) and rate > 0 else np.nan
    jitter_us = np.abs(np.diff(signals.state_sent_ns) - period_ns) / 1000.0
    left = bag.distance.between(-np.inf, end).values[-1:]
    return {
        "time to the goal": (bag.reached - bag.zero, "s"),
        "distance at the end": (1000 * largest(left), "mm"),
        "largest contact force": (largest(contact.column("max")), "N"),
        "largest external torque": (largest(np.abs(torque.values)), "Nm"),
        "ticks": (float(len(np.unique(ticks))), ""),
        "ticks missed": (float(np.nanmax(missed, initial=0.0)), ""),
        "round trip p50": (percentile(signals.answers_ns / 1000.0, 50.0), "µs"),
        "round trip p99": (percentile(signals.answers_ns / 1000.0, 99.0), "µs"),
        "round trip p99.9": (percentile(signals.answers_ns / 1000.0, 99.9), "µs"),
        "plan takes p50": (percentile(took, 50.0), "ms"),
        "plan takes p95": (percentile(took, 95.0), "ms"),
        "plan takes at most": (largest(took), "ms"),
        "greatest plan age": (1000 * largest(signals.plan_age(ticks)), "ms"),
        "time above the permitted force": (_time_above(signals.contact_force, bag.budget), "ms"),
        "external torque, of what stops the arm": (100 * _threshold_share(signals, bag.budget), "%"),
        "largest command, of its limit": (100 * largest(np.abs(signals.command.values) / bag.torque_limits), "%"),
        "tick jitter p50": (percentile(jitter_us, 50.0), "µs"),
        "tick jitter p99": (percentile(jitter_us, 99.0), "µs"),
        "plans": (float(len(signals.plans.time)), ""),
    }


def _time_above(force: Series, budget: ContactBudget) -> float:
    """Time with a contact force above the permitted force, ms; NaN without any force."""
    if len(force.time) < 2:
        return float("nan")
    return float(1000.0 * np.diff(force.time)[force.column("max")[:-1] > budget.permitted_force].sum())


def _threshold_share(signals: EpisodeSignals, budget: ContactBudget) -> float:
    """Greatest ratio of any joint's external torque to the threshold that stops the arm at the joint's speed."""
    torque, velocity = signals.external_torque, signals.velocity
    thresholds = np.tile(budget.torque_thresholds, (len(torque.time), 1))
    if len(velocity.time):
        rows = np.minimum(np.searchsorted(velocity.time, torque.time), len(velocity.time) - 1)
        thresholds += np.array(budget.torque_per_speed) * np.abs(np.nan_to_num(velocity.values[rows]))
    return largest(np.abs(torque.values) / thresholds)


def largest(values: Array) -> float:
    """The largest finite value; NaN without any."""
    return percentile(values, 100.0)


def percentile(values: Array, percent: float) -> float:
    """A percentile of the finite values; NaN without any."""
    values = values[np.isfinite(values)]
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def quantity(value: float, unit: str) -> str:
    """A number with its unit, in a few digits; a dash where it is unknown."""
    if unit == "µs" and abs(value) >= 10_000:
        value, unit = value / 1000, "ms"
    return f"{number(value)} {unit}".rstrip() if np.isfinite(value) else "–"


def number(value: float) -> str:
    """A number in a few digits; a dash where it is unknown."""
    if not np.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 1000 or value == round(value) else f"{value:.3g}"


def as_json(bag: ReportBag) -> dict[str, Any]:
    """All numbers, for JSON; NaN where unknown."""
    return {
        "bag": str(bag.path),
        "verdict": bag.verdict,
        "good": bag.good,
        "metrics": {name: {"value": value, "unit": unit} for name, (value, unit) in metrics(bag).items()},
        "events": [
            {"time_s": event.time - bag.zero, "level": event.level, "source": event.name, "message": event.message}
            for event in bag.signals.safety
        ],
        "plan_stop_reasons": dict(sorted(Counter(bag.signals.stop_reasons).items())),
        "topics": {name: topic.message_count for name, topic in sorted(bag.reader.topics.items())},
        "custom_data": dict(bag.reader.custom_data),
        "settings": {node: dict(values) for node, values in bag.settings.items()},
        "notes": list(bag.notes),
    }
