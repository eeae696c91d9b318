"""Findings of the doctor: a verdict, the facts and what to do about them; as a table and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from contact_reach_ros.resources import write_json


class Verdict(Enum):
    """Result of a check."""

    PASS = "pass"
    WARN = "warn"
    """The stack works, but not as well as it should."""
    FAIL = "fail"
    """Must be fixed before a run."""


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes
    ----------
    verdict
        Of the check.
    found
        The facts, in one line.
    fix
        What to do; empty only when the check passed.
    """

    verdict: Verdict
    found: str
    fix: str = ""


Report = Mapping[str, Mapping[str, Finding]]
"""Findings by the part of the system, and by the name of the check."""


def graded(found: str, fix: str, *, fail: bool = False, warn: bool = False) -> Finding:
    """Make a finding that fails or warns under these conditions, else passes without the fix."""
    if fail or warn:
        return Finding(Verdict.FAIL if fail else Verdict.WARN, found, fix)
    return Finding(Verdict.PASS, found)


def failed(found: str, fix: str) -> Finding:
    """Make a finding that must be fixed before a run."""
    return Finding(Verdict.FAIL, found, fix)


def verdicts(report: Report) -> Counter[Verdict]:
    """Count the verdicts."""
    return Counter(finding.verdict for findings in report.values() for finding in findings.values())


def exit_code(report: Report) -> int:
    """Return 1 if anything failed, else 0."""
    return int(verdicts(report)[Verdict.FAIL] > 0)


def print_table(report: Report, console: Console) -> None:
    """Print one line for each finding, its fix below it, and the sums at the end."""
    colours = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}
    table = Table(show_edge=False, pad_edge=False)
    table.add_column("check", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("found", overflow="fold")
    for part, findings in report.items():
        table.add_section()
        table.add_row(f"[bold]{escape(part)}[/bold]", "", "")
        for name, finding in findings.items():
            colour = colours[finding.verdict]
            text = escape(finding.found)
            if finding.fix:
                text += f"\n[{colour}]fix:[/{colour}] {escape(finding.fix)}"
            table.add_row(f"  {escape(name)}", f"[{colour}]{finding.verdict.value}[/{colour}]", text)
    console.print(table)
    counts = verdicts(report)
    console.print(", ".join(f"{counts[verdict]} {verdict.value}" for verdict in Verdict))


def write_report(report: Report, file: Path) -> None:
    """Write {exit_code, verdicts: {pass, warn, fail}, checks: [{part, name, verdict, found, fix}]}."""
    counts = verdicts(report)
    content = {
        "exit_code": exit_code(report),
        "verdicts": {verdict.value: counts[verdict] for verdict in Verdict},
        "checks": [
            {"part": part, "name": name, **asdict(finding), "verdict": finding.verdict.value}
            for part, findings in report.items()
            for name, finding in findings.items()
        ],
    }
    write_json(file, content)
