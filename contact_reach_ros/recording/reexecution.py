"""`contact-reach replay BAG --recompute`: what came out then against what comes out now."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording.bag_reader import BagReader
from contact_reach_ros.recording.recompute import (
    TOLERANCE,
    Other,
    Rerun,
    realtime_factor,
    rerun_controller,
    rerun_observer,
)
from contact_reach_ros.recording.recorded_inputs import RecordedInputs

IDENTICAL, DIFFERENT = 0, 1


@dataclass(frozen=True)
class RecomputeOptions:
    """What the command line asks for."""

    bag: Path
    other: Path | None = None
    """Parameter file to execute with instead of the recorded settings."""
    plan: int | None = None
    """Number of the plan to make again."""
    json: Path | None = None


def run_recompute(options: RecomputeOptions) -> int:
    """Execute again and say what differs; returns `IDENTICAL` or `DIFFERENT`, which other settings always are not.

    Raises
    ------
    BagError, SettingsError
        If the bag lacks what is needed, or the other settings are not accepted.
    """
    bag, other = BagReader(options.bag), Other(options.other)
    inputs = RecordedInputs(bag)
    for note in bag.notes:
        print(f"note: {note}")
    report: dict[str, Any] = {"bag": str(options.bag)}
    differs = False
    if options.plan is None:
        reruns = reexecute(inputs, other)
        for rerun in reruns.values():
            differs |= rerun.first_difference is not None
            _print_rerun(rerun, inputs, other)
            report[rerun.node] = _as_json(rerun, inputs, other)
        report["recompute_realtime_factor"] = realtime_factor(reruns)
        print(f"executed again {report['recompute_realtime_factor']:.1f} times as fast as the robot")
    else:
        report["plan"], differs = _plan_again(inputs, options.plan, other)
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    return DIFFERENT if differs else IDENTICAL


def reexecute(inputs: RecordedInputs, other: Other) -> dict[str, Rerun]:
    """Controller and observer by name, as far as the bag has what they took in.

    Raises
    ------
    BagError
        If it has that of neither.
    """
    reruns = {}
    missing: list[BagError] = []
    for name, rerun in (("controller", rerun_controller), ("observer", rerun_observer)):
        try:
            reruns[name] = rerun(inputs, other)
        except BagError as error:
            missing.append(error)
    if not reruns:
        raise missing[0]
    for lacking in missing:
        print(f"note: {lacking}")
    return reruns


def recompute_realtime_factor(bag: Path) -> float:
    """How many times faster than the robot controller and observer are executed again; for benchmarks."""
    return realtime_factor(reexecute(RecordedInputs(BagReader(bag)), Other()))


def _print_rerun(rerun: Rerun, inputs: RecordedInputs, other: Other) -> None:
    total = len(rerun.stamp_ns)
    if other:
        change = np.abs(rerun.values - rerun.recorded)
        largest = float(np.nanmax(change)) if np.isfinite(change).any() else float("nan")
        said = f"with {other.file}: up to {largest:.3g} Nm from the recorded ones"
    elif rerun.first_difference is not None:
        said = f"DIFFERENT from {rerun.first_difference.text(_origin_ns(inputs))}"
    elif rerun.checked:
        said = f"identical (largest difference {rerun.largest_difference:.1g} Nm, tolerance {TOLERANCE:g})"
    else:
        said = "nothing could be compared"
    print(f"{rerun.node:11} {total} outputs, {rerun.checked} compared: {said}")
    for reason in rerun.reasons:
        print(f"{'':11} stops: {reason}")
    for note in rerun.notes:
        print(f"{'':11} note: {note}")


def _as_json(rerun: Rerun, inputs: RecordedInputs, other: Other) -> dict[str, Any]:
    first = rerun.first_difference
    return {
        "outputs": len(rerun.stamp_ns),
        "compared": rerun.checked,
        "identical": None if other or not rerun.checked else first is None,
        "largest_difference_Nm": rerun.largest_difference if np.isfinite(rerun.largest_difference) else None,
        "first_difference": None if first is None else first._asdict() | {"text": first.text(_origin_ns(inputs))},
        "stop_reasons": list(rerun.reasons),
        "notes": list(rerun.notes),
    }


def _plan_again(inputs: RecordedInputs, number: int, other: Other) -> tuple[dict[str, Any], bool]:
    # The planner's libraries take seconds to import.
    from contact_reach_ros.recording.recompute_plans import RecordedPlans

    rerun = RecordedPlans(inputs).solve(number, other)
    plan, recorded = rerun.plan, rerun.statistics
    print(f"plan {number}, made again from {rerun.solved} plan(s) in {rerun.seconds:.1f} s")
    if other:
        print(f"with {other.file}:")
    elif rerun.first_difference is None:
        print("identical, bit for bit")
    else:
        print(f"DIFFERENT: {rerun.first_difference}")
    print(f"  {'':22}{'recorded':>14}{'now':>14}")
    rows = {"steps": plan.steps, "cost": plan.cost, **{f"cost {key}": value for key, value in plan.cost_terms.items()}}
    for name, value in rows.items():
        print(f"  {name:22}{float(recorded.get(name, 'nan')):14.6g}{value:14.6g}")
    print(f"  {'largest contact force':22}{'':14}{plan.predicted_contact_forces.max():14.3g} N")
    result = {
        "number": number,
        "plans_solved": rerun.solved,
        "identical": None if other else rerun.first_difference is None,
        "first_difference": None if rerun.first_difference is None else rerun.first_difference._asdict(),
        "recorded": dict(recorded),
        "now": rows,
        "positions_m": plan.positions.tolist(),
    }
    return result, rerun.first_difference is not None


def _origin_ns(inputs: RecordedInputs) -> int:
    return int(inputs.states.stamp_ns[0])
