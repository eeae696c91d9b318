"""What benches print and write."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import SettingsError

Report = dict[str, Any]
"""A bench's result, as JSON has it."""


def say(line: str) -> None:
    """Print a line of progress on the error output."""
    print(line, file=sys.stderr, flush=True)


def table(header: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def percentiles(values: Array | Sequence[float]) -> dict[str, float]:
    """Median, 95th percentile and maximum."""
    p50, p95, largest = np.percentile(values, [50, 95, 100])
    return {"p50": float(p50), "p95": float(p95), "max": float(largest)}


def write_report(report: Mapping[str, Any], file: Path | None) -> None:
    """Write a report as JSON, if there is a file for it."""
    if file is not None:
        write_whole(file, json.dumps(report, indent=2) + "\n")


def write_whole(file: Path, text: str) -> None:
    """Replace a file's content at once: whatever happens, it is the old or the new one."""
    file.parent.mkdir(parents=True, exist_ok=True)
    new = file.with_name(f".{file.name}.new")
    with new.open("w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    new.replace(file)


def read_report(file: Path, bench: str) -> dict[str, Any]:
    """Read the report of a finished run of a bench.

    Raises
    ------
    SettingsError
        If the file cannot be read or holds no report of that bench.
    """
    try:
        report = json.loads(file.read_text())
    except OSError as error:
        raise SettingsError(
            f"{file}: cannot be read ({error.strerror}); expected the JSON of a finished run"
        ) from error
    except ValueError as error:
        raise SettingsError(f"{file}: not JSON ({error}); expected that of a finished run") from error
    if not isinstance(report, dict) or report.get("bench") != bench:
        raise SettingsError(f"{file}: not a result of bench {bench}")
    return report
