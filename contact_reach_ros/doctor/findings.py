"""What a check says: a verdict, what was found, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any


class Verdict(Enum):
    """How a check came out."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes
    ----------
    name
        What was checked.
    verdict
        How it came out.
    found
        What there is, in one line.
    fix
        What to do; empty only when the check passed.
    values
        Numbers behind it, for the JSON report.
    """

    name: str
    verdict: Verdict
    found: str
    fix: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """For the JSON report."""
        return {
            "name": self.name,
            "verdict": self.verdict.value,
            "found": self.found,
            "fix": self.fix,
            "values": dict(self.values),
        }


def passed(name: str, found: str, **values: Any) -> Finding:
    """All is well."""
    return Finding(name, Verdict.PASS, found, values=values)


def warned(name: str, found: str, fix: str, **values: Any) -> Finding:
    """Works, but not as well as it should."""
    return Finding(name, Verdict.WARN, found, fix, values)


def failed(name: str, found: str, fix: str, **values: Any) -> Finding:
    """Has to be put right before a run."""
    return Finding(name, Verdict.FAIL, found, fix, values)


@dataclass(frozen=True)
class Check:
    """A check that has not been made yet; `make` returns one finding or several."""

    name: str
    make: Callable[[], Finding | list[Finding]]

    def run(self) -> list[Finding]:
        """The findings; a check that breaks is one that failed, whatever broke it."""
        try:
            result = self.make()
        except Exception as error:  # a doctor that dies of what it finds helps nobody
            fix = "put right what the message names; if it names nothing of yours, report it as a bug of this check"
            return [failed(self.name, f"{type(error).__name__}: {error}", fix)]
        return result if isinstance(result, list) else [result]
