"""docs/faults.md: its tables are made from the kinds in the code and from what a run of the matrix found."""

from __future__ import annotations

from pathlib import Path

from arm_simulation import ARM
from cases import CASES, Case
from page_tables import replaced

from benchmarks.fault_checks import end_of, speed_share
from contact_reach_ros.simulation.fault_kinds import kinds_table

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
KINDS_HEADING, MATRIX_HEADING = "## Kinds", "## Matrix"


def row_head(case: Case) -> str:
    """What a line of the matrix begins with: the case and what is required."""
    fault = case.happening.replace('"', "'")
    return f"| {case.scene} | {case.planner} | {case.rate} | `{fault}` | {_cell(case.requirement)} | "


def matrix_table(outcomes: dict[str, tuple]) -> str:
    """All cases, with what became of them."""
    lines = [
        "| scene | planner | rate, Hz | fault | required | end | reason | contact force, N | joint speed / limit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for case in CASES:
        result, lacking = outcomes[case.name]
        end = end_of(result).value + (" (**not met**)" if lacking else "")
        # The controller repeats the observer's reason, and may add its own.
        said = list(dict.fromkeys(result.reasons.values()))
        reasons = [reason for reason in said if not any(other.startswith(f"{reason};") for other in said)]
        share = speed_share(result, ARM)
        force = result.contact_forces.max() if len(result.contact_forces) else 0.0
        lines.append(f"{row_head(case)}{end} | {_cell('; '.join(reasons)) or '-'} | {force:.0f} | {share:.2f} |")
    return "\n".join(lines) + "\n"


def write(outcomes: dict[str, tuple]) -> None:
    """Put new tables into the page."""
    text = PAGE.read_text()
    for heading, table in ((KINDS_HEADING, kinds_table(ARM)), (MATRIX_HEADING, matrix_table(outcomes))):
        text = replaced(text, heading, table)
    PAGE.write_text(text)


def _cell(text: str) -> str:
    return text.replace("|", " or ")
