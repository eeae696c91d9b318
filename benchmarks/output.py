"""Command lines of the benchmarks, and what they print and write."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.resources import versions

Report = dict[str, Any]
"""A benchmark's result, as JSON has it."""

BAD_INPUT = 2
"""Exit code."""


def command_line(description: str | None, spread: bool = False) -> argparse.ArgumentParser:
    """A parser with the options of all benchmarks: --json and, for work that is `spread` over processes, --workers."""
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument("--json", dest="file", type=Path, metavar="FILE", help="write the result as JSON")
    if spread:
        parser.add_argument("--workers", type=int, metavar="W", help="processes (default: one per core)")
    return parser


def given(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> dict[str, Any]:
    """The options that are given, with tuples for lists; the defaults are those of what takes them.

    Raises `SettingsError` if --workers asks for no process.
    """
    options = vars(parser.parse_args(arguments))
    if options.get("workers", 1) < 1:
        raise SettingsError(f"--workers {options['workers']}: expected at least 1")
    return {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}


def command_of(name: str, options: Any) -> str:
    """The command line that makes a benchmark's dataclass of options, without what has its default."""
    words = ["python", "-m", f"benchmarks.{name}"]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        texts = [str(text) for text in (value if isinstance(value, tuple) else (value,))]
        # Folders of one machine mean nothing to others.
        texts = [Path(text).name if Path(text).is_absolute() else text for text in texts]
        if field.default is dataclasses.MISSING:
            words += texts
        elif value != field.default:
            words += [f"--{field.name.replace('_', '-')}", *texts]
    return shlex.join(words)


def run_command(main: Callable[[], int | None]) -> None:
    """Run the `main` of a benchmark and exit with its code; errors of its input end in one line."""
    try:
        sys.exit(main() or 0)
    except ContactReachError as error:
        print(error, file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(130)


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


def machine() -> dict[str, object]:
    """Processor, cores, load and versions, for reports."""
    return {"cpu": _processor(), "cores": os.cpu_count(), "load": os.getloadavg()[0], **versions()}


def _processor() -> str:
    """Name of the processor, as Linux knows it."""
    information = Path("/proc/cpuinfo")
    for line in information.read_text().splitlines() if information.is_file() else []:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def write_report(report: Mapping[str, Any], file: Path | None) -> None:
    """Write a report as JSON, if there is a file for it, at once: the file holds the old report or the new one."""
    if file is None:
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    new = file.with_name(f".{file.name}.new")
    with new.open("w") as stream:
        stream.write(json.dumps(report, indent=2) + "\n")
        stream.flush()
        os.fsync(stream.fileno())
    new.replace(file)


def read_report(file: Path, bench: str = "") -> dict[str, Any]:
    """Read the report of a run of a benchmark, of any if it is not named.

    Raises
    ------
    SettingsError
        If the file cannot be read or holds no report of that benchmark.
    """
    try:
        report = json.loads(file.read_text())
    except OSError as error:
        raise SettingsError(
            f"{file}: cannot be read ({error.strerror}); expected the JSON of a finished run"
        ) from error
    except ValueError as error:
        raise SettingsError(f"{file}: not JSON ({error}); expected that of a finished run") from error
    if not isinstance(report, dict) or "bench" not in report or (bench and report["bench"] != bench):
        raise SettingsError(f"{file}: not the result of {f'benchmark {bench}' if bench else 'a benchmark'}")
    return report
