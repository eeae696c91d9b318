"""How soon the observer sees a push, and how seldom it takes free motion for one."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.free_motion import LONGEST_CONTROLLED
from benchmarks.identified import compare
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
from contact_reach_ros.drawing.palette import BLUE, GREY, VERMILION
from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.settings import COMMANDED, MEASURED, ObserverSettings
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
    plot: Path | None = None,
    rate: Sequence[float] = (),
    commanded: bool = False,
    friction: float = MismatchSettings().friction_scale,
    identified: bool = False,
) -> dict[str, Any]:
    """Measure, print a table, write JSON to `file` and the ROC curve to `plot`.

    Parameters
    ----------
    minutes
        Simulated free motion in which false stops are counted.
    rate
        Rates of joint states to compare, Hz, instead of measuring everything at 1 kHz.
    commanded
        Observe from commands, not from measured torques.
    friction
        Factor on the joint friction of the arm that differs from its model.
    identified
        Identify that arm instead, and compare what is seen before and after.

    Raises
    ------
    InputError
        If `minutes` is not above zero and at most `MAX_MINUTES`, or a rate cannot be simulated.
    """
    if not 0.0 < minutes <= MAX_MINUTES:
        raise InputError(f"minutes = {minutes:g}: expected a number above 0, at most {MAX_MINUTES:g}")
    mismatch = MismatchSettings(friction_scale=friction)
    settings = ObserverSettings(torque_source=COMMANDED if commanded else MEASURED)
    if rate:
        return _compare_rates(rate, minutes, file, mismatch, settings)
    arm = load_arm()
    budget = load_budget().resolve(arm)
    if identified:
        report: dict[str, Any] = {"machine": machine(), "minutes": minutes}
        report |= compare(arm, mismatch, budget, settings, minutes, PUSHES)
        write_report(report, file)
        return report
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
        "torque_source": settings.torque_source,
        "friction": friction,
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
    if plot is not None:
        _draw(report["roc"], plot)
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


def _draw(roc: dict[str, list[float]], file: Path) -> None:
    figure = Figure(figsize=(9.0, 4.0), dpi=130)
    over_scale, curve = figure.subplots(1, 2)
    over_scale.semilogx(roc["scale"], roc["seen_share"], color=BLUE)
    over_scale.set_xlabel("factor on the thresholds of a contact")
    over_scale.set_ylabel(f"pushes of {PUSH:g} N seen within {_PROMPT_MS:g} ms", color=BLUE)
    ticks = [0.2, 0.5, 1.0, 2.0, 5.0]
    over_scale.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    over_scale.set_xticks([], minor=True)
    over_scale.axvline(1.0, color=GREY, linestyle=":")
    false = over_scale.twinx()
    false.semilogx(roc["scale"], roc["false_contacts_per_hour"], color=VERMILION)
    false.set_ylabel("false contacts per hour", color=VERMILION)
    false.set_yscale("symlog", linthresh=1.0)
    curve.plot(roc["false_contacts_per_hour"], roc["seen_share"], color=BLUE, marker=".")
    at = int(np.argmin(np.abs(np.log(roc["scale"]))))
    curve.plot(
        roc["false_contacts_per_hour"][at], roc["seen_share"][at], "o", color=VERMILION, label="contact budget as it is"
    )
    curve.set_xscale("symlog", linthresh=1.0)
    curve.set_xlabel("false contacts per hour of free motion")
    curve.set_ylabel(f"pushes of {PUSH:g} N seen within {_PROMPT_MS:g} ms")
    curve.legend(loc="lower right", frameon=False)
    for panel in (over_scale, curve):
        panel.grid(True, color="#dddddd", linewidth=0.6)
    figure.tight_layout()
    FigureCanvasAgg(figure)
    try:
        figure.savefig(file)
    except (OSError, ValueError) as error:
        raise InputError(f"plot '{file}' cannot be written: {error}") from error


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    minutes = "simulated free motion in which false stops are counted (default: 60)"
    parser.add_argument("--minutes", type=float, help=minutes)
    instead = parser.add_mutually_exclusive_group()
    rates = "compare rates of joint states, as 100 200 500 1000"
    instead.add_argument("--rate", type=float, nargs="+", metavar="HZ", help=rates)
    identified = "compare before and after an identification of the arm"
    instead.add_argument("--identified", action="store_true", help=identified)
    parser.add_argument("--commanded", action="store_true", help="observe from commands, not from measured torques")
    friction = "on the joint friction of the simulated arm (default: 3)"
    parser.add_argument("--friction", type=float, metavar="FACTOR", help=friction)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw pushes seen against false contacts")
    bench_observer(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
