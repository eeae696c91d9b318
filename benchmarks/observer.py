"""How soon the observer sees a push, and how seldom it takes free motion for one."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.free_motion import LONGEST_CONTROLLED
from benchmarks.observer_trials import (
    PUSH_TICKS,
    RISE,
    SCALES,
    FreeRun,
    Push,
    debounced,
    least_push,
    move_freely,
    push_often,
    step_63_error,
)
from benchmarks.output import command_line, given, machine, run_command, write_report
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings

LATENCY_TARGETS_MS = {"p50": 8.0, "p95": 20.0}
LEVEL = "contact"
"""That detects a push: reported at the thresholds of a contact."""
PUSH = 50.0
LIGHT_PUSH = 10.0
"""N."""
PUSHES = 300
MAX_MINUTES = 6000.0
RATES = (100.0, 125.0, 200.0, 250.0, 500.0, 1000.0)
"""Hz."""

_MATCHING_MINUTES = 2.0
"""At most, in which the arm is its model: for comparison only."""
_CONTROLLED_HZ = 1.0 / LONGEST_CONTROLLED
_PROMPT_MS = LATENCY_TARGETS_MS["p95"]


def bench_observer(
    minutes: float = 60.0,
    file: Path | None = None,
    rate: Sequence[float] = (),
) -> dict[str, Any]:
    """Measure, print a table and write JSON to `file`.

    Parameters
    ----------
    minutes
        Simulated free motion in which false stops are counted.
    rate
        Rates of joint states to compare, Hz, instead of measuring everything at 1 kHz.

    Raises
    ------
    InputError
        If `minutes` is not above zero and at most `MAX_MINUTES`, or a rate cannot be simulated.
    """
    if not 0.0 < minutes <= MAX_MINUTES:
        raise InputError(f"minutes = {minutes:g}: expected a number above 0, at most {MAX_MINUTES:g}")
    mismatch, settings = MismatchSettings(), ObserverSettings()
    if rate:
        return _compare_rates(rate, minutes, file, mismatch, settings)
    arm = load_arm()
    budget = load_budget().resolve(arm)
    began = time.process_time()
    steps = [step_63_error(arm, joint) for joint in range(arm.n)]
    pushes = push_often(arm, PUSH, PUSHES, budget, TICK, mismatch, settings)
    light = push_often(arm, LIGHT_PUSH, PUSHES // 2, budget, TICK, mismatch, settings)
    pushed_s = time.process_time() - began
    differing = move_freely(arm, mismatch, minutes, budget, TICK, settings)
    matching = move_freely(arm, NO_MISMATCH, min(minutes, _MATCHING_MINUTES), budget, TICK, settings)
    report = {
        "machine": machine(),
        "gain": settings.momentum.gain,
        "level": LEVEL,
        "step_63_error": max(steps, key=abs),
        "step_63_error_by_joint": steps,
        "free_rms_nm": {
            "mismatch": differing.rms,
            "matching": matching.rms,
            "max": max(differing.rms),
            "largest_mismatch": differing.largest,
            "largest_matching": matching.largest,
        },
        **_pushed(pushes),
        "light_push": {"force_N": LIGHT_PUSH, **_pushed(light)},
        "minutes": minutes,
        "false_stops": differing.stops,
        "false_stops_per_hour": len(differing.stops) * 60.0 / minutes,
        "false_contacts_per_hour": differing.contacts * 60.0 / minutes,
        "cpu_s": {"steps and pushes": pushed_s, "in all": time.process_time() - began},
        "least_push_N": least_push(pushes, PUSH),
        "roc": _roc(pushes, differing, minutes),
    }
    print(_table(report))
    write_report(report, file)
    return report


def _compare_rates(
    rates: Sequence[float], minutes: float, file: Path | None, differing: MismatchSettings, settings: ObserverSettings
) -> dict[str, Any]:
    """Latency and false stops at each rate, with an arm that differs from its model and one that does not."""
    for rate in rates:
        if rate not in RATES:
            raise InputError(f"rate = {rate:g} Hz: expected one of {', '.join(f'{each:g}' for each in RATES)}")
    arm = load_arm()
    budget = load_budget().resolve(arm)
    found: dict[str, Any] = {}
    print(f"{PUSHES} pushes of {PUSH:g} N, {minutes:g} min of free motion; the arm is controlled at the rate that is")
    print(f"observed, at 1 kHz where that is below {_CONTROLLED_HZ:g} Hz")
    print("   Hz  arm         latency ms p50   p95   max  missed  false stops per hour")
    for rate in rates:
        cases = {}
        for name, mismatch in (("mismatch", differing), ("matching", NO_MISMATCH)):
            pushed = _pushed(push_often(arm, PUSH, PUSHES, budget, 1.0 / rate, mismatch, settings))
            free = move_freely(arm, mismatch, minutes, budget, 1.0 / rate, settings)
            stops = len(free.stops) * 60.0 / minutes
            cases[name] = {**pushed, "false_stops_per_hour": stops, "false_stops": free.stops}
            p50, p95, largest = pushed["detection_latency_ms"].values()
            missed = pushed["missed_contacts"]
            print(f"{rate:5g}  {name:10s} {p50:15.1f} {p95:5.1f} {largest:5.1f} {missed:7d} {stops:12.1f}")
        found[f"{rate:g}"] = {**cases["mismatch"], "matching": cases["matching"]}
    report = {"machine": machine(), "minutes": minutes, "rates": found}
    write_report(report, file)
    return report


def _pushed(pushes: Sequence[Push]) -> dict[str, Any]:
    latencies = np.array([1e3 * push.latency for push in pushes])
    seen = latencies[np.isfinite(latencies)]
    named = [push.link_right for push in pushes if push.link_right is not None]
    quantiles = np.quantile(seen, [0.5, 0.95, 1.0]).tolist() if seen.size else [math.nan] * 3
    return {
        "pushes": len(pushes),
        "detection_latency_ms": dict(zip(("p50", "p95", "max"), quantiles, strict=True)),
        "missed_contacts": int(len(pushes) - seen.size),
        "stopped_share": float(np.mean([push.stopped for push in pushes])),
        "link_right_share": float(np.mean(named)) if named else math.nan,
    }


def _roc(pushes: Sequence[Push], free: FreeRun, minutes: float) -> dict[str, list[float]]:
    """Pushes seen promptly and contacts reported falsely, over factors on the thresholds of a contact."""
    prompt = round(1e-3 * _PROMPT_MS / TICK)
    peaks = np.array([debounced(push.exceedance[:prompt]).max() for push in pushes])
    return {
        "scale": list(SCALES),
        "seen_share": [float((peaks > scale).mean()) for scale in SCALES],
        "false_contacts_per_hour": [count * 60.0 / minutes for count in free.onsets],
    }


def _table(report: dict[str, Any]) -> str:
    free = report["free_rms_nm"]
    latency, light = report["detection_latency_ms"], report["light_push"]
    targets = ", ".join(f"{name} {value:g}" for name, value in LATENCY_TARGETS_MS.items())

    def joints(values: Sequence[float]) -> str:
        return "".join(f"{value:7.2f}" for value in values)

    return "\n".join(
        [
            f"time to {100 * RISE:.0f} % of a step less 1/K: largest {100 * report['step_63_error']:+.1f} % of it",
            f"free motion, joint by joint, Nm   {joints(free['mismatch'])}  rms with mismatch",
            f"                                  {joints(free['largest_mismatch'])}  largest with mismatch",
            f"                                  {joints(free['matching'])}  rms when the arm is its model",
            f"                                  {joints(free['largest_matching'])}  largest",
            f"{report['pushes']} pushes of {PUSH:g} N at mid-arm, level {LEVEL}: latency ms "
            f"p50 {latency['p50']:.1f}  p95 {latency['p95']:.1f}  max {latency['max']:.1f} (targets: {targets}); "
            f"{report['missed_contacts']} missed; link right {100 * report['link_right_share']:.0f} %; "
            f"{100 * report['stopped_share']:.0f} % would stop the arm",
            f"least push that would be seen, N: p50 {report['least_push_N']['p50']:.1f}  "
            f"p95 {report['least_push_N']['p95']:.1f}",
            f"{light['pushes']} pushes of {LIGHT_PUSH:g} N: latency ms p50 {light['detection_latency_ms']['p50']:.1f}; "
            f"{light['missed_contacts']} missed within {PUSH_TICKS * 1e3 * TICK:.0f} ms; "
            f"{100 * light['stopped_share']:.0f} % would stop the arm",
            f"{report['minutes']:g} min of free motion with mismatch: {len(report['false_stops'])} false stops, "
            f"{report['false_stops_per_hour']:.1f} per hour; {report['false_contacts_per_hour']:.1f} false contacts "
            f"per hour; CPU time in all {report['cpu_s']['in all']:.0f} s",
            *report["false_stops"],
        ]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    minutes = "simulated free motion in which false stops are counted (default: 60)"
    parser.add_argument("--minutes", type=float, help=minutes)
    rates = "compare rates of joint states, as 100 200 500 1000"
    parser.add_argument("--rate", type=float, nargs="+", metavar="HZ", help=rates)
    bench_observer(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
