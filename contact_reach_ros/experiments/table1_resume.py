"""Going on with an interrupted run of `contact-reach bench table1`: its file, and whether its settings are the same."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments.grid import (
    Cell,
    Record,
    cell_of,
)
from contact_reach_ros.experiments.output import Report, read_report

if TYPE_CHECKING:
    pass


def partial_of(file: Path) -> Path:
    """The file with the report of an unfinished run, beside that of the finished one."""
    return file.with_name(f"{file.name}.partial")


def refuse_to_lose(file: Path | None, resume: bool) -> None:
    """Raise `SettingsError` if a run that does not resume would overwrite the episodes of an interrupted one."""
    if file is not None and not resume and partial_of(file).exists():
        raise SettingsError(
            f"{partial_of(file)} holds the episodes of a run that was interrupted: go on with it by --resume, or "
            "remove the file"
        )


def refuse_to_drop(file: Path | None, grid: Sequence[Cell], done: dict[Cell, Record]) -> None:
    """Raise `SettingsError` if the finished episodes are not all in the grid."""
    outside = sorted(set(done) - set(grid), key=dataclasses.astuple)
    if outside:
        raise SettingsError(
            f"{file}: holds {len(outside)} episodes that these options leave out, such as {outside[0]}: go on with the "
            "options of that run or with more, or begin another file"
        )


def read_earlier(file: Path | None, header: Report) -> tuple[dict[str, Any], dict[Cell, Record]]:
    """Latencies and episodes of an unfinished or finished run with the same settings, if there is one."""
    assert file is not None
    source = next((path for path in (partial_of(file), file) if path.exists()), None)
    if source is None:
        return {}, {}
    earlier = read_report(source, "table1")
    check_same(earlier["settings"], header["settings"], str(source))
    header["machine"] = earlier["machine"]
    return earlier["latencies"], {cell_of(record): record for record in earlier["episodes"]}


def check_same(earlier: Any, now: Any, where: str) -> None:
    """Compare the settings of two runs.

    Raises
    ------
    SettingsError
        If a setting that both runs have differs; `where` and the setting are named.
    """
    if isinstance(earlier, dict) and isinstance(now, dict):
        for key in earlier.keys() & now.keys():
            check_same(earlier[key], now[key], f"{where}: {key}")
    elif earlier != now:
        raise SettingsError(
            f"{where} was {earlier!r} and is {now!r} now: a run can only go on with the settings it began with; set it "
            "back, or begin another file"
        )
