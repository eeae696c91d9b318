"""`contact-reach reexecute BAG`: compares recorded outputs with re-executed ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.loops import TOLERANCE, Reexecution, reexecute
from contact_reach_ros.reexecution.settings import ChangedSettings

IDENTICAL, DIFFERENT = 0, 1


def run_reexecution(bag: Path, plan: int | None = None, other: Path | None = None, file: Path | None = None) -> int:
    """Re-execute and report what differs; returns `DIFFERENT` if anything does and no settings are changed.

    `plan` is the number of one to solve again, instead of controller and observer; `other` a parameter file with
    settings to change; `file` takes the result as JSON. Raises `BagError` or `SettingsError` if the bag lacks what is
    needed, or the changed settings are not accepted.
    """
    reader, changes = BagReader(bag, of_stack=True), ChangedSettings(other)
    inputs = RecordedInputs(reader)
    for note in reader.notes:
        print(f"note: {note}")
    report: dict[str, Any] = {"bag": str(bag)}
    differs = False
    if plan is None:
        missing: list[BagError] = []
        for node in ("controller", "observer"):
            try:
                found = reexecute(node, inputs, changes)
            except BagError as error:
                missing.append(error)
                continue
            differs |= found.first_difference is not None
            _print(found, inputs, changes)
            report[node] = _as_json(found, inputs, changes)
        if "controller" not in report and "observer" not in report:
            raise missing[0]
        for lacking in missing:
            print(f"note: {lacking}")
    else:
        report["plan"], differs = _reexecute_plan(inputs, plan, changes)
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return DIFFERENT if differs else IDENTICAL


def _print(found: Reexecution, inputs: RecordedInputs, changes: ChangedSettings) -> None:
    total = len(found.stamp_ns)
    if changes:
        change = np.abs(found.values - found.recorded)
        largest = float(np.nanmax(change)) if np.isfinite(change).any() else float("nan")
        result = f"with {changes.file}: up to {largest:.3g} Nm from the recorded ones"
    elif found.first_difference is not None:
        result = f"DIFFERENT from {found.first_difference.text(inputs.origin_ns)}"
    elif found.compared:
        result = f"identical (largest difference {found.largest_difference:.1g} Nm, tolerance {TOLERANCE:g})"
    else:
        result = "nothing could be compared"
    print(f"{found.node:11} {total} outputs, {found.compared} compared: {result}")
    for reason in found.reasons:
        print(f"{'':11} stops: {reason}")
    for note in found.notes:
        print(f"{'':11} note: {note}")


def _as_json(found: Reexecution, inputs: RecordedInputs, changes: ChangedSettings) -> dict[str, Any]:
    first = found.first_difference
    return {
        "outputs": len(found.stamp_ns),
        "compared": found.compared,
        "identical": None if changes or not found.compared else first is None,
        "largest_difference_Nm": found.largest_difference if np.isfinite(found.largest_difference) else None,
        "first_difference": None if first is None else first._asdict() | {"text": first.text(inputs.origin_ns)},
        "stop_reasons": list(found.reasons),
        "notes": list(found.notes),
    }


def _reexecute_plan(inputs: RecordedInputs, number: int, changes: ChangedSettings) -> tuple[dict[str, Any], bool]:
    # The planner's libraries take seconds to import.
    from contact_reach_ros.reexecution.plans import RecordedPlans

    found = RecordedPlans(inputs).solve(number, changes)
    plan, recorded = found.plan, found.statistics
    print(f"plan {number}, solved in {found.seconds:.1f} s")
    if changes:
        print(f"with {changes.file}:")
    elif found.exceeded:
        print(f"DIFFERENT: {found.exceeded}")
    else:
        largest = ", ".join(f"{name} {value:.1g}" for name, value in found.differences.items())
        print(f"EQUAL within tolerances (largest differences: {largest})")
    print(f"  {'':22}{'recorded':>14}{'now':>14}")
    rows = {"cost": plan.cost, **{f"cost {key}": value for key, value in plan.cost_terms.items()}}
    for name, value in rows.items():
        print(f"  {name:22}{float(recorded.get(name, 'nan')):14.6g}{value:14.6g}")
    print(f"  {'largest contact force':22}{'':14}{plan.predicted_contact_forces.max():14.3g} N")
    result = {
        "number": number,
        "equal": None if changes else not found.exceeded,
        "differences": dict(found.differences),
        "recorded": dict(recorded),
        "now": rows,
        "positions_m": plan.positions.tolist(),
    }
    return result, bool(found.exceeded)
