"""docs/faults.md: its tables are made from the kinds in the code and from what a run of the matrix found."""

from __future__ import annotations

from pathlib import Path

from cases import CASES, Case

from contact_reach_ros.experiments.fault_checks import end_of, speed_share
from contact_reach_ros.plant.fault_kinds import kinds_table

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
KINDS_HEADING, MATRIX_HEADING = "## Kinds", "## Matrix"


def row_head(case: Case) -> str:
    """What a line of the matrix begins with: the case and what is required."""
    fault = case.fault.replace('"', "'")
    return f"| {case.scene} | {case.planner} | `{fault}` | {_cell(case.requirement)} | "


def matrix_table(outcomes: dict[str, tuple]) -> str:
    """All cases, with what became of them."""
    lines = [
        "| scene | planner | fault | required | end | reason | contact force, N | joint speed / limit |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case in CASES:
        result, lacking = outcomes[case.name]
        end = end_of(result).value + (" (**not met**)" if lacking else "")
        # The controller repeats the observer's reason, and may add its own.
        said = list(dict.fromkeys(result.reasons.values()))
        reasons = [reason for reason in said if not any(other.startswith(f"{reason};") for other in said)]
        force = result.contact_forces.max() if len(result.contact_forces) else 0.0
        lines.append(
            f"{row_head(case)}{end} | {_cell('; '.join(reasons)) or '-'} | {force:.0f} | {speed_share(result):.2f} |"
        )
    return "\n".join(lines) + "\n"


def write(outcomes: dict[str, tuple]) -> None:
    """Put new tables into the page."""
    text = PAGE.read_text()
    for heading, table in ((KINDS_HEADING, kinds_table()), (MATRIX_HEADING, matrix_table(outcomes))):
        text = replaced(text, heading, table)
    PAGE.write_text(text)


def replaced(text: str, heading: str, table: str) -> str:
    """The page with the table after a heading replaced; what stands before it and after it stays."""
    lines = text.splitlines()
    start = lines.index(heading) + 1
    end = next((at for at in range(start, len(lines)) if lines[at].startswith("#")), len(lines))
    is_made = [line.startswith("|") for line in lines[start:end]]
    first = start + is_made.index(True) if True in is_made else end
    last = start + len(is_made) - is_made[::-1].index(True) if True in is_made else end
    return "\n".join([*lines[:first], *table.rstrip("\n").split("\n"), *lines[last:]]) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", " or ")
