"""docs/faults.md: its table is made from the kinds in the code and from what a run of the matrix found."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from arm_simulation import ARM
from cases import CASES, KINDS

from benchmarks.fault_checks import end_of, speed_share
from contact_reach_ros.simulation.faults import Fault

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
HEADING = "## Kinds and outcomes"


def row_head(kind: type[Fault]) -> str:
    """The beginning of a row: the kind, what happens, and the number of its cases."""
    count = sum(any(isinstance(fault, kind) for fault in case.faults) for case in CASES)
    return f"| `{kind.__name__}` | {' '.join(kind.__doc__.split())} | {count} | "


def table(outcomes: dict[str, tuple]) -> str:
    """A row for each kind, with the ends of its cases and the largest force and speed among them."""
    lines = [
        "| fault | what happens | cases | ends | stopped for | contact force, N | joint speed / limit |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        found = [outcomes[case.name] for case in CASES if any(isinstance(fault, kind) for fault in case.faults)]
        results = [result for result, _ in found]
        ends = Counter(end_of(result).value + (" (**not met**)" if lacking else "") for result, lacking in found)
        said = Counter(_cause(reason) for result in results for reason in result.reasons.values())
        force = max(result.contact_forces.max(initial=0.0) for result in results)
        speed = max(speed_share(result, ARM) for result in results)
        shown = ", ".join(f"{end} {count}" for end, count in sorted(ends.items()))
        causes = ", ".join(cause for cause, _ in said.most_common(2))
        lines.append(f"{row_head(kind)}{shown} | {causes or '-'} | {force:.0f} | {speed:.2f} |")
    return "\n".join(lines) + "\n"


def _cause(reason: str) -> str:
    """A reason without its joint, its numbers and its remedy."""
    text = re.sub("|".join(ARM.joint_names), "a joint", reason)
    return re.split(r" (?:by|with|for|is|on|while) |; |: let|, | \d", text)[0]


def write(outcomes: dict[str, tuple]) -> None:
    """Replace the table of the page, or put one below its heading."""
    before, heading, section = PAGE.read_text().partition(HEADING)
    text, end, after = section.partition("\n## ")
    kept = [line for line in text.rstrip().splitlines() if not line.startswith("|")]
    PAGE.write_text(before + heading + "\n".join(kept).rstrip() + "\n\n" + table(outcomes) + end + after)
