"""What `contact-reach bench control --seconds` makes of the counters of a running stack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.timing import counts_between, percentiles_us, read_counts

DRIVER, CONTROLLER = "driver", "controller"
"""Nodes whose counters are looked at."""

_MEMORY_S = 60.0
"""Memory is compared with what it is after the first minute, or after half the time if that is shorter."""
_TURN_S = 20.0
"""Without pages, and then with them."""


@dataclass(frozen=True)
class ControlBench:
    """What is run.

    Attributes
    ----------
    seconds
        Time that is measured, s.
    load
        Processes beside the stack that never sleep.
    scene, seed
        Where the arm goes to and fro between its start and the target.
    pages
        The viewer runs, too, and half of the time, in turns, serves so many pages.
    """

    seconds: float = 60.0
    load: int = 0
    scene: str = "ball"
    seed: int = 0
    pages: int = 0

    def check(self) -> None:
        """Raise `SettingsError` for what cannot be run."""
        if not 2.0 <= self.seconds <= 86400.0:
            raise SettingsError(f"--seconds {self.seconds:g}: expected 2 to 86400 s")
        if not 0 <= self.load <= 64:
            raise SettingsError(f"--load {self.load}: expected 0 to 64 processes")
        if not 0 <= self.pages <= 8:
            raise SettingsError(f"--pages {self.pages}: expected 0 to 8 pages")

    @property
    def parts(self) -> list[tuple[float, int]]:
        """What the time is divided into: seconds, and how many pages are open."""
        if not self.pages:
            settled = min(_MEMORY_S, 0.5 * self.seconds)
            return [(settled, 0), (self.seconds - settled, 0)]
        turns = max(round(self.seconds / (2.0 * _TURN_S)), 1)
        return [(self.seconds / (2.0 * turns), count) for _ in range(turns) for count in (0, self.pages)]


@dataclass(frozen=True)
class Sample:
    """What was known at one time.

    Attributes
    ----------
    diagnostics
        Newest values of driver and controller, by name.
    memory
        By process, MB.
    timer
        Ticks of the bare timer that were due, and those of them that were missed.
    """

    diagnostics: Mapping[str, Mapping[str, str]]
    memory: Mapping[str, float]
    timer: tuple[int, int]

    def number(self, key: str) -> int:
        """One of the driver's counters."""
        return int(self.diagnostics[DRIVER][key])

    def counts(self, node: str, name: str) -> dict[int, int]:
        """One of a node's histograms: counts by upper edge in µs."""
        return read_counts(self.diagnostics[node][f"{name} counts"])


class Part(NamedTuple):
    """Some of the time: how many pages were open, and what was known when it began and ended."""

    pages: int
    first: Sample
    last: Sample

    @property
    def ticks(self) -> int:
        """So many were due."""
        return self.last.number("ticks") - self.first.number("ticks")

    @property
    def missed_fraction(self) -> float:
        """Share of the ticks that were missed."""
        return (self.last.number("missed ticks") - self.first.number("missed ticks")) / max(self.ticks, 1)

    @property
    def timer_missed_fraction(self) -> float:
        """Share of the bare timer's ticks that were missed."""
        due, missed = np.subtract(self.last.timer, self.first.timer).tolist()
        return float(missed / max(due, 1))


@dataclass(frozen=True)
class Run:
    """What was seen of the stack.

    Attributes
    ----------
    parts
        In order.
    reached
        How many goals were.
    realtime
        Whether the loops had real-time priority.
    """

    parts: Sequence[Part]
    reached: int
    realtime: bool


def make_report(bench: ControlBench, echoes: Mapping[str, float], run: Run) -> dict[str, Any]:
    """The result as JSON has it."""
    whole = Part(bench.pages, run.parts[0].first, run.parts[-1].last)
    first, settled, last = whole.first, run.parts[0].last, whole.last
    trip = percentiles_us(counts_between(first.counts(DRIVER, "round trip"), last.counts(DRIVER, "round trip")))
    late = percentiles_us(counts_between(first.counts(DRIVER, "wake-up late"), last.counts(DRIVER, "wake-up late")))
    compute = percentiles_us(counts_between(first.counts(CONTROLLER, "compute"), last.counts(CONTROLLER, "compute")))
    growth = {name: last.memory[name] - settled.memory[name] for name in last.memory}
    return {
        "seconds": bench.seconds,
        "load": bench.load,
        "scene": bench.scene,
        "realtime": run.realtime,
        "ticks": whole.ticks,
        "missed_fraction": whole.missed_fraction,
        "timer_missed_fraction": whole.timer_missed_fraction,
        "round_trip_us": {key: trip[key] for key in ("p50", "p99", "p999")},
        "wakeup_late_us": {key: late[key] for key in ("p50", "p99")},
        "compute_us": {key: compute[key] for key in ("p50", "p99")},
        "echo_us": dict(echoes),
        "ratio_to_echo": trip["p50"] / echoes["p50"],
        "memory_growth_mb": max(growth.values()),
        "memory_growth_mb_by_process": growth,
        "goals_reached": run.reached,
        "pages": _compare_pages(run.parts) if bench.pages else None,
    }


def _compare_pages(parts: Sequence[Part]) -> dict[str, Any]:
    """Missed ticks with pages and without, from turns next to each other, and the same of the bare timer."""
    closed, opened = ([part.missed_fraction for part in parts[first::2]] for first in (0, 1))
    timers = [np.array([part.timer_missed_fraction for part in parts[first::2]]) for first in (0, 1)]
    differences = np.subtract(opened, closed)
    error = float(differences.std(ddof=1) / np.sqrt(len(differences))) if len(differences) > 1 else None
    return {
        "count": parts[1].pages,
        "missed_fraction_closed": closed,
        "missed_fraction_open": opened,
        "difference_mean": float(differences.mean()),
        "difference_standard_error": error,
        "difference_median": float(np.median(differences)),
        "timer_difference_mean": float((timers[1] - timers[0]).mean()),
    }


def print_report(report: Mapping[str, Any]) -> None:
    """The result as a table."""
    trip, late, compute, echoes = (report[key] for key in ("round_trip_us", "wakeup_late_us", "compute_us", "echo_us"))
    growth = report["memory_growth_mb_by_process"]
    most = max(growth, key=growth.__getitem__)
    rows = [
        ("ticks", f"{report['ticks']}, missed {100 * report['missed_fraction']:.3f} %"),
        ("bare timer", f"missed {100 * report['timer_missed_fraction']:.3f} % in the same time"),
        ("round trip", f"p50 {trip['p50']:.0f}, p99 {trip['p99']:.0f}, p99.9 {trip['p999']:.0f} us"),
        ("woken up late", f"p50 {late['p50']:.0f}, p99 {late['p99']:.0f} us"),
        ("controller", f"p50 {compute['p50']:.0f}, p99 {compute['p99']:.0f} us"),
        ("bare echo", f"p50 {echoes['p50']:.0f} us; the loop takes {report['ratio_to_echo']:.2f} times as long"),
        ("memory", f"{report['memory_growth_mb']:+.2f} MB at most, {most}"),
        ("goals reached", f"{report['goals_reached']}"),
        ("real time", "SCHED_FIFO" if report["realtime"] else "no: not permitted"),
    ]
    compared = report["pages"]
    if compared is not None:
        means = [100.0 * np.mean(compared[f"missed_fraction_{kind}"]) for kind in ("open", "closed")]
        error = compared["difference_standard_error"]
        text = f"{means[0]:.3f} % missed with {compared['count']} open, {means[1]:.3f} % without"
        text += f": {100.0 * compared['difference_mean']:+.3f} %"
        text += "" if error is None else f", standard error {100.0 * error:.3f} %"
        rows.append(("pages", f"{text}; bare timer {100.0 * compared['timer_difference_mean']:+.3f} %"))
    for label, text in rows:
        print(f"  {label:16}{text}")
