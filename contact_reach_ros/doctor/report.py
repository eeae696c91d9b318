"""The doctor's findings as a table and as JSON."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from contact_reach_ros.doctor.findings import Finding, Verdict

Report = Mapping[str, Sequence[Finding]]
"""Findings by the part of the system that they are about."""

_COLOURS = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}


def verdicts(report: Report) -> Counter[Verdict]:
    """How often there was each verdict."""
    return Counter(finding.verdict for findings in report.values() for finding in findings)


def exit_code(report: Report) -> int:
    """1 if anything failed, else 0."""
    return int(verdicts(report)[Verdict.FAIL] > 0)


def print_table(report: Report, console: Console) -> None:
    """One line for each finding, its fix below it, and the sums at the end."""
    table = Table(show_edge=False, pad_edge=False)
    table.add_column("check", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("found", overflow="fold")
    for part, findings in report.items():
        table.add_section()
        table.add_row(f"[bold]{escape(part)}[/bold]", "", "")
        for finding in findings:
            colour = _COLOURS[finding.verdict]
            text = escape(finding.found)
            if finding.fix:
                text += f"\n[{colour}]fix:[/{colour}] {escape(finding.fix)}"
            table.add_row(f"  {escape(finding.name)}", f"[{colour}]{finding.verdict.value}[/{colour}]", text)
    console.print(table)
    counts = verdicts(report)
    console.print(", ".join(f"{counts[verdict]} {verdict.value}" for verdict in Verdict))


def write_json(report: Report, file: Path) -> None:
    """Write {exit_code, verdicts: {pass, warn, fail}, checks: [{part, name, verdict, found, fix, values}]}."""
    counts = verdicts(report)
    content = {
        "exit_code": exit_code(report),
        "verdicts": {verdict.value: counts[verdict] for verdict in Verdict},
        "checks": [{"part": part, **finding.as_json()} for part, findings in report.items() for finding in findings],
    }
    file.write_text(json.dumps(content, indent=2) + "\n")
