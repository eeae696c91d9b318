"""What a recorded episode amounts to, in numbers and as a picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.errors import BagError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.recording.bag_reader import BagReader
from contact_reach_ros.recording.plot import SUCCESS_DISTANCE, EpisodeCurves, Marker, episode_plot
from contact_reach_ros.recording.signals import EpisodeSignals, first_below, goal_distance, read_signals
from contact_reach_ros.robot.kinematics import flange_positions
from contact_reach_ros.units import NANOSECONDS

ERROR_LEVEL = 2
"""Of a DiagnosticStatus: the arm is stopped."""


@dataclasses.dataclass(frozen=True)
class EpisodeSummary:
    """One goal, from the moment it was sent. The field names are those of the JSON report.

    Attributes
    ----------
    reached
        Whether the flange came within 0.01 m of the goal.
    final_error_m
        Distance from the goal at the end.
    duration_s
        Time until the goal was reached; NaN if it was not.
    distance_m
        From start to goal.
    time_ratio
        `duration_s` over the least time that the bound on Δx and the gains allow; NaN if the goal is where the arm is.
    max_contact_force_N
        Largest force on one robot body.
    max_external_torque_Nm
        Largest residual of the observer on one joint.
    ticks, missed_ticks
        Of the driver.
    round_trip_us
        From a joint state to its command: p50, p99, p999.
    plan_ms
        Solve time: p50, p95, max.
    plan_age_ms_max
        Greatest age of the plan in force at a joint state, since it took effect.
    safety_events
        Stops: time_s, source and reason.
    """

    reached: bool
    final_error_m: float
    duration_s: float
    distance_m: float
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
    """A bag with one goal, read once for summary and picture.

    Parameters
    ----------
    bag
        Directory, file, or a reader of one.
    least_duration
        Shortest time, s, from the flange's position at the start to the target's, both (3,) m.
    end_ns
        Stamp at which the episode ends, for example before the stack was shut down; the last joint state when None.
    signals
        The signals of the bag where they have been read already.

    Raises
    ------
    BagError
        If the bag cannot be read or holds no goal.
    """

    def __init__(
        self,
        bag: Path | BagReader,
        least_duration: Callable[[np.ndarray, np.ndarray], float],
        end_ns: int | None = None,
        signals: EpisodeSignals | None = None,
    ) -> None:
        reader = bag if isinstance(bag, BagReader) else BagReader(bag)
        self._signals = read_signals(reader) if signals is None else signals
        self._time, self._distance = goal_distance(self._signals, flange_positions)
        if not len(self._time):
            raise BagError(f"{reader.summary.path}: holds no goal with joint states; record goal_pose and joint_states")
        origin_ns = self._signals.origin_ns
        self._end = float(self._time[-1]) if end_ns is None else (end_ns - origin_ns) / NANOSECONDS
        self._start = self._signals.goals[0].time
        self._reached = first_below(self._time, self._distance, SUCCESS_DISTANCE, self._start)
        start_row = int(np.searchsorted(self._signals.position.time, self._start))
        start_row = min(start_row, len(self._signals.position.time) - 1)
        start_position = flange_positions(self._signals.position.values[start_row : start_row + 1])[0]
        target = self._signals.goals[0].position
        self._straight = float(np.linalg.norm(target - start_position))
        self._least_duration = least_duration(start_position, target)

    @property
    def start(self) -> float:
        """When the first goal was sent, s since the first joint state."""
        return self._start

    @property
    def reached(self) -> float | None:
        """When the goal was reached, s since the first joint state."""
        return self._reached

    @property
    def distance(self) -> tuple[np.ndarray, np.ndarray]:
        """Time (n,) in s since the first joint state, and distance (n,) of the flange from the goal, m."""
        return self._time, self._distance

    def summary(self) -> EpisodeSummary:
        """The numbers."""
        signals = self._signals
        duration = float("nan") if self._reached is None else self._reached - self._start
        last = int(np.searchsorted(self._time, self._end, side="right")) - 1
        contact, torque = signals.contact_force, signals.external_torque
        return EpisodeSummary(
            reached=self._reached is not None and self._reached <= self._end,
            final_error_m=float(self._distance[last]),
            duration_s=duration,
            distance_m=self._straight,
            time_ratio=duration / self._least_duration if self._least_duration > 0.0 else float("nan"),
            max_contact_force_N=_largest(contact.column("max")[self._inside(contact.time)]),
            max_external_torque_Nm=_largest(np.abs(torque.values[self._inside(torque.time)])),
            ticks=int(_last(signals, "driver/ticks", self._end, 0.0)),
            missed_ticks=int(_last(signals, "driver/missed ticks", self._end, 0.0)),
            round_trip_us={
                key: _last(signals, f"driver/round trip {key} us", self._end) for key in ("p50", "p99", "p999")
            },
            plan_ms={key: _last(signals, f"planner/solve {key} us", self._end) / 1000 for key in ("p50", "p95", "max")},
            plan_age_ms_max=1000 * self._greatest_plan_age(),
            safety_events=self._stops(),
        )

    def plot(self, file: Path, title: str, budget: ContactBudget) -> Path:
        """Draw distance, contact force and external torque over time."""
        signals = self._signals
        markers = [Marker(self._start, "goal sent", "goal")]
        if self._reached is not None:
            markers.append(Marker(self._reached, "reached", "reached"))
        markers += [Marker(stop["time_s"] + self._start, f"{stop['source']} stop", "safety") for stop in self._stops()]
        shown, contact, torque = self._time <= self._end, signals.contact_force, signals.external_torque
        curves = EpisodeCurves(
            self._time[shown],
            self._distance[shown],
            contact.time[contact.time <= self._end],
            contact.column("max")[contact.time <= self._end],
            contact.column("sum")[contact.time <= self._end],
            torque.time[torque.time <= self._end],
            torque.values[torque.time <= self._end],
            markers,
        )
        return episode_plot(
            curves,
            file,
            title=title,
            permitted_force=budget.permitted_force,
            torque_thresholds=budget.torque_thresholds,
        )

    def _inside(self, time: np.ndarray) -> np.ndarray:
        return (time >= self._start) & (time <= self._end)

    def _stops(self) -> list[dict[str, Any]]:
        """Each stop once, however often it was repeated."""
        stops: dict[tuple[str, str], float] = {}
        for event in self._signals.safety:
            if event.level >= ERROR_LEVEL and event.time <= self._end:
                stops.setdefault((event.name, event.message), event.time)
        return [
            {"time_s": time - self._start, "source": source, "reason": reason}
            for (source, reason), time in stops.items()
        ]

    def _greatest_plan_age(self) -> float:
        """Seconds; NaN without plans."""
        effects = self._signals.plan_times
        if not len(effects):
            return float("nan")
        ticks = self._signals.position.time
        ticks = ticks[(ticks >= effects[0]) & (ticks <= self._end)]
        return _largest(ticks - effects[np.searchsorted(effects, ticks, side="right") - 1])


def _largest(values: np.ndarray) -> float:
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
