"""Numbers of a recorded episode: one goal, until it is reached, the arm is stopped or the recording ends."""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from typing import Any

import numpy as np

from contact_reach_ros.arm import Arm, tip_positions
from contact_reach_ros.bags.signals import EpisodeSignals, goal_distance
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.settings import Settings

SUCCESS_DISTANCE = 0.01
"""The paper's delta, m: the goal is reached within it."""
BEFORE = 2.0
"""Time shown before the first goal or stop, s: a stack may have waited long for its goal."""


@dataclasses.dataclass(frozen=True)
class EpisodeSummary:
    """Numbers of one goal, from the moment it was sent; NaN where unknown, as those of a goal where there is none.

    Attributes
    ----------
    reached
        Whether the flange came within 0.01 m of the goal.
    final_error_m
        Distance from the goal at the end.
    duration_s
        Time until the goal was reached; NaN if it was not.
    watched_s
        Time from the sending of the goal to the end of the episode.
    distance_m
        Distance from start to goal.
    max_contact_force_N
        Largest force on one robot body.
    max_external_torque_Nm
        Largest residual of the observer on one joint.
    ticks, missed_ticks
        Joint states recorded until the end, and ticks that the driver reported as missed.
    round_trip_us
        From the sending of a joint state to the sending of its command: p50, p99, p999.
    plan_ms
        Solve time: p50, p95, max.
    plan_age_ms_max
        Greatest time at any joint state since the plan in force took effect.
    safety_events
        Stops: time_s, source and reason.
    """

    reached: bool
    final_error_m: float
    duration_s: float
    watched_s: float
    distance_m: float
    max_contact_force_N: float  # noqa: N815 - the unit's letter
    max_external_torque_Nm: float  # noqa: N815
    ticks: int
    missed_ticks: int
    round_trip_us: dict[str, float]
    plan_ms: dict[str, float]
    plan_age_ms_max: float
    safety_events: list[dict[str, Any]]

    @property
    def success(self) -> bool:
        """Reached, and never stopped."""
        return self.reached and not self.safety_events

    def as_json(self) -> dict[str, Any]:
        """Plain values; NaN becomes None."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)), parse_constant=lambda _: None)
        return plain


class Episode:
    """The episode of a bag's first goal; without a goal, the whole recording.

    Raises `BagError` if there is no joint state.

    Parameters
    ----------
    signals
        Signals of the bag.
    arm
        The recorded arm.
    end
        Latest end of the episode, such as the shutdown of the stack, s since the first joint state.
    timeout, settle
        Times after the start and after the goal was reached at which the episode ends at the latest, s.

    Attributes
    ----------
    start
        When the first goal was sent, s since the first joint state; 0 without a goal.
    has_goal
        Whether there is a goal.
    reached
        When the goal was reached, on the same clock; None if it was not.
    distance
        Distance of the flange from the goal: the column "distance", m; empty without a goal.
    """

    def __init__(
        self,
        signals: EpisodeSignals,
        arm: Arm,
        end: float = np.inf,
        timeout: float = np.inf,
        settle: float = np.inf,
    ) -> None:
        self._signals = signals
        self.distance = goal_distance(signals, partial(tip_positions, arm))
        position = signals.position
        known = np.isfinite(position.values).all(axis=1)
        if not known.any():
            raise BagError("holds no joint states of the arm; record joint_states")
        self.has_goal = bool(len(self.distance.time))
        self.start = float(signals.goals.time[0]) if self.has_goal else 0.0
        near = (self.distance.values[:, 0] <= SUCCESS_DISTANCE) & (self.distance.time >= self.start)
        self.reached = float(self.distance.time[near][0]) if near.any() else None
        settled = np.inf if self.reached is None else self.reached + settle
        self._end = min(float(position.time[-1]), end, self.start + timeout, settled)
        self._straight = float("nan")
        if self.has_goal:
            row = min(int(np.searchsorted(position.time, self.start)), len(position.time) - 1)
            start_position = tip_positions(arm, position.values[row : row + 1])[0]
            self._straight = float(np.linalg.norm(signals.goals.values[0] - start_position))

    @property
    def shown_from(self) -> float:
        """Start of the time range to show, s: shortly before the goal was sent, or before an earlier stop."""
        return min([self.start, *(self.start + stop["time_s"] for stop in self._stops())]) - BEFORE

    def summary(self) -> EpisodeSummary:
        """The numbers."""
        signals = self._signals
        ticks = signals.position.time[signals.position.time <= self._end]
        left = self.distance.between(-np.inf, self._end).values[-1:]
        took = np.array([plan.numbers.get("took ms", np.nan) for plan in signals.plans if plan.time <= self._end])
        contact = signals.contact_force.between(self.start, self._end)
        torque = signals.external_torque.between(self.start, self._end)
        return EpisodeSummary(
            reached=self.reached is not None and self.reached <= self._end,
            final_error_m=float(left[0, 0]) if len(left) else float("nan"),
            duration_s=float("nan") if self.reached is None else self.reached - self.start,
            watched_s=self._end - self.start,
            distance_m=self._straight,
            max_contact_force_N=largest(contact.column("max")),
            max_external_torque_Nm=largest(np.abs(torque.values)),
            ticks=len(np.unique(ticks)),
            missed_ticks=_missed_ticks(signals, self._end),
            round_trip_us=percentiles(signals.answers_ns / 1000.0, p50=50.0, p99=99.0, p999=99.9),
            plan_ms=percentiles(took, p50=50.0, p95=95.0, max=100.0),
            plan_age_ms_max=1000 * largest(signals.plan_age(ticks)),
            safety_events=self._stops(),
        )

    def _stops(self) -> list[dict[str, Any]]:
        """Each stop once, however often it was repeated."""
        stops: dict[tuple[str, str], float] = {}
        for event in self._signals.safety:
            # The stop that ends the run as planned is none of them.
            if event.is_stop and event.time < self._end:
                stops.setdefault((event.name, event.message), event.time)
        return [
            {"time_s": time - self.start, "source": source, "reason": reason}
            for (source, reason), time in stops.items()
        ]


def recorded_section(signals: EpisodeSignals, node: str, prefix: str, default: Settings, notes: list[str]) -> Any:
    """The section `prefix` of a node's recorded settings, of the type of `default`.

    If the bag lacks the section, or this version refuses it, returns `default` and appends the reason to `notes`.
    """
    kind = type(default)
    recorded = signals.settings.get(node, {})
    names = [entry.name for entry in kind.declared()]
    values = {name: recorded[f"{prefix}.{name}"] for name in names if f"{prefix}.{name}" in recorded}
    if not values:
        notes.append(f"the bag lacks the {prefix} of the {node}: the package's own is assumed")
        return default
    try:
        return kind.from_mapping(values, f"settings of the {node}")
    except SettingsError as error:
        notes.append(f"the {prefix} of the {node} cannot be used, the package's own is assumed: {error}")
        return default


def largest(values: np.ndarray) -> float:
    """The largest finite value; NaN without any."""
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else float("nan")


def percentiles(values: np.ndarray, **percents: float) -> dict[str, float]:
    """Percentiles of the finite values by name; NaN without any."""
    values = values[np.isfinite(values)]
    return {
        name: float(np.percentile(values, percent)) if len(values) else float("nan")
        for name, percent in percents.items()
    }


def _missed_ticks(signals: EpisodeSignals, end: float) -> int:
    """Ticks that the driver reported as missed up to `end`, s; 0 if it reported none."""
    return int(np.nanmax(signals.missed_ticks.between(-np.inf, end).values, initial=0.0))
