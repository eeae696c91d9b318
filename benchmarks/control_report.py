"""What `contact-reach bench control --seconds` makes of the counters of a running stack."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.timing import counts_between, percentiles_us, read_counts

DRIVER, CONTROLLER = "driver", "controller"
"""Nodes whose counters are looked at."""

_MEMORY_S = 60.0
"""Memory is compared with what it is after the first minute, or after half the time if that is shorter."""


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
    """

    seconds: float = 60.0
    load: int = 0
    scene: str = "ball"
    seed: int = 0

    def check(self) -> None:
        """Raise `SettingsError` for what cannot be run."""
        if not 2.0 <= self.seconds <= 86400.0:
            raise SettingsError(f"--seconds {self.seconds:g}: expected 2 to 86400 s")
        if not 0 <= self.load <= 64:
            raise SettingsError(f"--load {self.load}: expected 0 to 64 processes")

    @property
    def settled(self) -> float:
        """Time after which memory should not grow any more, s."""
        return min(_MEMORY_S, 0.5 * self.seconds)


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


@dataclass(frozen=True)
class Run:
    """What was seen of the stack: at the beginning, when memory had settled, and at the end.

    Attributes
    ----------
    reached
        How many goals were.
    realtime
        Whether the loops had real-time priority.
    """

    first: Sample
    settled: Sample
    last: Sample
    reached: int
    realtime: bool


def make_report(bench: ControlBench, echoes: Mapping[str, float], run: Run) -> dict[str, Any]:
    """The result as JSON has it."""
    first, last = run.first, run.last
    ticks = last.number("ticks") - first.number("ticks")
    missed = last.number("missed ticks") - first.number("missed ticks")
    timer_due, timer_missed = np.subtract(last.timer, first.timer).tolist()
    trip = percentiles_us(counts_between(first.counts(DRIVER, "round trip"), last.counts(DRIVER, "round trip")))
    late = percentiles_us(counts_between(first.counts(DRIVER, "wake-up late"), last.counts(DRIVER, "wake-up late")))
    compute = percentiles_us(counts_between(first.counts(CONTROLLER, "compute"), last.counts(CONTROLLER, "compute")))
    growth = {name: last.memory[name] - run.settled.memory[name] for name in last.memory}
    return {
        "seconds": bench.seconds,
        "load": bench.load,
        "scene": bench.scene,
        "realtime": run.realtime,
        "ticks": ticks,
        "missed_fraction": missed / max(ticks, 1),
        "timer_missed_fraction": timer_missed / max(timer_due, 1),
        "round_trip_us": {key: trip[key] for key in ("p50", "p99", "p999")},
        "wakeup_late_us": {key: late[key] for key in ("p50", "p99")},
        "compute_us": {key: compute[key] for key in ("p50", "p99")},
        "echo_us": dict(echoes),
        "ratio_to_echo": trip["p50"] / echoes["p50"],
        "memory_growth_mb": max(growth.values()),
        "memory_growth_mb_by_process": growth,
        "goals_reached": run.reached,
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
    for label, text in rows:
        print(f"  {label:16}{text}")
