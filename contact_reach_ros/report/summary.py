"""Numbers and plot of a recorded episode: one goal, until it is reached, the arm is stopped or the recording ends."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import tip_positions
from contact_reach_ros.bags.signals import EpisodeSignals, goal_distance
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.speed_limit import least_duration
from contact_reach_ros.report.plot import BEFORE, SUCCESS_DISTANCE, Marker, episode_figure
from contact_reach_ros.settings import Settings


@dataclasses.dataclass(frozen=True)
class EpisodeSummary:
    """Numbers of one goal, from the moment it was sent; the JSON report has the same field names.

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
    limit_s
        Least time that the transfer model's speed bound permits for this distance, with the settings of the run.
    time_ratio
        `duration_s` over `limit_s`; NaN if the arm starts at the goal.
    max_contact_force_N
        Largest force on one robot body.
    max_external_torque_Nm
        Largest residual of the observer on one joint.
    ticks, missed_ticks
        Joint states recorded until the end, and ticks that the driver reported as missed.
    round_trip_us
        Time from a joint state to its command: p50, p99, p999.
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
    limit_s: float
    time_ratio: float
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
        return {key: _plain(value) for key, value in dataclasses.asdict(self).items()}


class Episode:
    """The episode of a bag's first goal.

    Raises `BagError` if there is no goal or no joint state.

    Parameters
    ----------
    signals
        Signals of the bag.
    arm
        The recorded arm.
    end
        Latest end of the episode, such as the shutdown of the stack, s since the first joint state; the last joint
        state when None.
    timeout, settle
        Times after the start and after the goal was reached at which the episode ends at the latest, s.

    Attributes
    ----------
    start
        When the first goal was sent, s since the first joint state.
    reached
        When the goal was reached, on the same clock; None if it was not.
    distance
        Distance of the flange from the goal: the column "distance", m.
    """

    def __init__(
        self,
        signals: EpisodeSignals,
        arm: Arm,
        end: float | None = None,
        timeout: float = np.inf,
        settle: float = np.inf,
    ) -> None:
        self._signals = signals
        self.distance = goal_distance(signals, partial(tip_positions, arm))
        time = self.distance.time
        if not len(time):
            raise BagError("holds no goal with joint states; record goal_pose and joint_states")
        self.start = float(signals.goals.time[0])
        self.reached = first_below(time, self.distance.values[:, 0], SUCCESS_DISTANCE, self.start)
        settled = np.inf if self.reached is None else self.reached + settle
        self._end = min(float(time[-1]) if end is None else end, self.start + timeout, settled)
        position = signals.position
        row = min(int(np.searchsorted(position.time, self.start)), len(position.time) - 1)
        start_position, target = tip_positions(arm, position.values[row : row + 1])[0], signals.goals.values[0]
        self._straight = float(np.linalg.norm(target - start_position))
        self._limit = least_duration(
            start_position,
            target,
            recorded_section(signals, "planner", "planning", PlanningSettings(), []),
            recorded_section(signals, "controller", "impedance", ImpedanceSettings(), []),
        )

    @property
    def shown_from(self) -> float:
        """Start of the time range to show, s: shortly before the goal was sent, or before an earlier stop."""
        return min([self.start, *(self.start + stop["time_s"] for stop in self._stops())]) - BEFORE

    def summary(self) -> EpisodeSummary:
        """The numbers."""
        signals = self._signals
        duration = float("nan") if self.reached is None else self.reached - self.start
        ticks = signals.position.time[signals.position.time <= self._end]
        last = max(int(np.searchsorted(self.distance.time, self._end, side="right")) - 1, 0)
        contact = signals.contact_force.between(self.start, self._end)
        torque = signals.external_torque.between(self.start, self._end)
        return EpisodeSummary(
            reached=self.reached is not None and self.reached <= self._end,
            final_error_m=float(self.distance.values[last, 0]),
            duration_s=duration,
            watched_s=self._end - self.start,
            distance_m=self._straight,
            limit_s=self._limit,
            time_ratio=duration / self._limit if self._limit > 0.0 else float("nan"),
            max_contact_force_N=largest(contact.column("max")),
            max_external_torque_Nm=largest(np.abs(torque.values)),
            ticks=len(np.unique(ticks)),
            missed_ticks=int(_last(signals, "driver/missed ticks", self._end, 0.0)),
            round_trip_us={
                key: _last(signals, f"driver/round trip {key} us", self._end) for key in ("p50", "p99", "p999")
            },
            plan_ms={key: _last(signals, f"planner/solve {key} us", self._end) / 1000 for key in ("p50", "p95", "max")},
            plan_age_ms_max=1000 * largest(signals.plan_age(ticks)),
            safety_events=self._stops(),
        )

    def plot(self, file: Path, title: str, budget: ContactBudget) -> None:
        """Draw distance, contact force and external torque over time as a PNG.

        Raises `BagError` if the file cannot be written.
        """
        markers = [Marker(self.start, "goal sent", "goal")]
        if self.reached is not None:
            markers.append(Marker(self.reached, "reached", "reached"))
        markers += [Marker(stop["time_s"] + self.start, f"{stop['source']} stop", "safety") for stop in self._stops()]
        signals = self._signals
        figure = episode_figure(
            self.distance.between(-np.inf, self._end),
            signals.contact_force.between(-np.inf, self._end),
            signals.external_torque.between(-np.inf, self._end),
            markers,
            title,
            budget.permitted_force,
            budget.torque_thresholds,
        )
        try:
            figure.savefig(file, format="png")
        except OSError as error:
            raise BagError(f"plot '{file}' cannot be written: {error.strerror}") from error

    def _stops(self) -> list[dict[str, Any]]:
        """Each stop once, however often it was repeated."""
        stops: dict[tuple[str, str], float] = {}
        for event in self._signals.safety:
            if event.is_stop and event.time <= self._end:
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


def first_below(time: np.ndarray, values: np.ndarray, limit: float, after: float = 0.0) -> float | None:
    """First time, from `after` on, at which the values are at or below a limit; None if they never are."""
    found = np.flatnonzero((values <= limit) & (time >= after))
    return float(time[found[0]]) if len(found) else None


def largest(values: np.ndarray) -> float:
    """The largest finite value; NaN without any."""
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else float("nan")


def _last(signals: EpisodeSignals, key: str, end: float, default: float = float("nan")) -> float:
    """Last value of a diagnostics entry up to `end`, or the first one there is."""
    series = signals.diagnostics.get(key)
    if series is None or not len(series.time):
        return default
    row = max(int(np.searchsorted(series.time, end, side="right")) - 1, 0)
    return float(series.values[row, 0])


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
