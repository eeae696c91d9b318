"""`contact-reach reexecute BAG`: compares recorded outputs with re-executed ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.loops import TOLERANCE, Loop, reexecute
from contact_reach_ros.resources import write_json

IDENTICAL, DIFFERENT = 0, 1


def run_reexecution(bag: Path, plan: int | None = None, other: Path | None = None, file: Path | None = None) -> int:
    """Re-execute and report what differs.

    Returns `DIFFERENT` if anything does and no settings are changed, or if nothing could be compared.

    `plan` is the number of one to solve again, instead of controller and observer; `other` a parameter file with other
    settings of these; `file` takes the numbers as JSON. Raises `BagError` if the bag lacks what is needed,
    `SettingsError` if settings are not accepted, `InputError` if the file cannot be written.
    """
    reader = BagReader(bag, of_stack=True)
    try:
        inputs = RecordedInputs(reader)
    finally:
        for note in reader.notes:
            print(f"note: {note}")
    report: dict[str, Any] = {"bag": str(bag)}
    if plan is not None:
        report["plan"], differs = _reexecute_plan(inputs, plan)
    else:
        differs, missing = False, []
        for node in ("controller", "observer"):
            try:
                found = reexecute(node, inputs, other)
            except BagError as error:
                missing.append(error)
                continue
            differs |= found.first_difference is not None or (other is None and not found.compared)
            _print(found, inputs, other)
            report[node] = _as_json(found, inputs)
        if len(missing) == 2:
            raise missing[0]
        for lacking in missing:
            print(f"note: {lacking}")
    if file is not None:
        write_json(file, report)
    return DIFFERENT if differs else IDENTICAL


def _print(found: Loop, inputs: RecordedInputs, other: Path | None) -> None:
    if other is not None:
        result = f"with {other}: up to {found.largest_difference:.3g} Nm from the recorded ones"
    elif found.first_difference is not None:
        result = f"DIFFERENT from {found.first_difference.text(inputs.origin_ns)}"
    elif found.compared:
        result = f"identical (largest difference {found.largest_difference:.1g} Nm, tolerance {TOLERANCE:g})"
    else:
        result = "nothing could be compared"
    print(f"{found.node:11} {found.outputs} outputs, {found.compared} compared: {result}")
    for reason in found.reasons:
        print(f"{'':11} stops: {reason}")
    for note in found.notes:
        print(f"{'':11} note: {note}")


def _as_json(found: Loop, inputs: RecordedInputs) -> dict[str, Any]:
    first = found.first_difference
    return {
        "outputs": found.outputs,
        "compared": found.compared,
        "identical": first is None if found.compared else None,
        "largest_difference_Nm": found.largest_difference,
        "first_difference": None if first is None else first._asdict() | {"text": first.text(inputs.origin_ns)},
        "stop_reasons": list(found.reasons),
        "notes": list(found.notes),
    }


def _reexecute_plan(inputs: RecordedInputs, number: int) -> tuple[dict[str, Any], bool]:
    """Solve a plan again; returns its numbers, and whether it differs."""
    # The planner's libraries take seconds to import.
    from contact_reach_ros.reexecution.plans import solve_again

    found = solve_again(inputs, number)
    plan, recorded = found.plan, found.statistics
    print(f"plan {number}")
    if found.exceeded:
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
        "equal": not found.exceeded,
        "differences": dict(found.differences),
        "recorded": dict(recorded),
        "now": rows,
        "positions_m": plan.positions.tolist(),
    }
    return result, bool(found.exceeded)
