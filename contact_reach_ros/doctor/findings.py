"""Findings of the doctor: a verdict, what was found and what to do about it; as a table and as JSON."""

from __future__ import annotations

import functools
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any, ParamSpec

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from contact_reach_ros.errors import ContactReachError

_P = ParamSpec("_P")


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
    values
        Numbers behind it, for the JSON report.
    name
        What was checked.
    """

    verdict: Verdict
    found: str
    fix: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""


def passed(found: str, **values: Any) -> Finding:
    """Make a finding that needs no action."""
    return Finding(Verdict.PASS, found, values=values)


def warned(found: str, fix: str, **values: Any) -> Finding:
    """Make a finding of what works, but not as well as it should."""
    return Finding(Verdict.WARN, found, fix, values)


def failed(found: str, fix: str, **values: Any) -> Finding:
    """Make a finding of what must be fixed before a run."""
    return Finding(Verdict.FAIL, found, fix, values)


def graded(found: str, fix: str, *, fail: bool = False, warn: bool = False, **values: Any) -> Finding:
    """Make a finding that fails or warns under these conditions, else passes without the fix."""
    if fail or warn:
        return (failed if fail else warned)(found, fix, **values)
    return passed(found, **values)


def check(
    name: str | Callable[..., str], fix: str = "correct what the message names"
) -> Callable[[Callable[_P, Finding]], Callable[_P, Finding]]:
    """Make a check of a function that returns a finding: it gets a name, and fails where the function raises.

    Only errors that a check may meet in what it looks at count, `ContactReachError` and `OSError`.

    Parameters
    ----------
    name
        Of the check, or a function that makes it of the arguments.
    fix
        What to do where the function raises.
    """

    def decorate(make: Callable[_P, Finding]) -> Callable[_P, Finding]:
        @functools.wraps(make)
        def run(*args: _P.args, **kwargs: _P.kwargs) -> Finding:
            try:
                finding = make(*args, **kwargs)
            except (ContactReachError, OSError) as error:
                finding = failed(str(error), fix)
            return replace(finding, name=name if isinstance(name, str) else name(*args, **kwargs))

        return run

    return decorate


Report = Mapping[str, Sequence[Finding]]
"""Findings by the part of the system that they are about."""

_COLOURS = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}


def verdicts(report: Report) -> Counter[Verdict]:
    """Count the verdicts."""
    return Counter(finding.verdict for findings in report.values() for finding in findings)


def exit_code(report: Report) -> int:
    """Return 1 if anything failed, else 0."""
    return int(verdicts(report)[Verdict.FAIL] > 0)


def print_table(report: Report, console: Console) -> None:
    """Print one line for each finding, its fix below it, and the sums at the end."""
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
        "checks": [
            {"part": part, **asdict(finding), "verdict": finding.verdict.value}
            for part, findings in report.items()
            for finding in findings
        ],
    }
    file.write_text(json.dumps(content, indent=2) + "\n")
