"""Results that survive an interruption: JSON lines, each written at once, next to the file of the finished run."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from contact_reach_ros.errors import SettingsError

SUFFIX = ".partial"


def journal_of(file: Path) -> Path:
    """Where the results of an unfinished run are."""
    return file.with_name(file.name + SUFFIX)


class Journal:
    """A header and then one record after the other.

    Parameters
    ----------
    file
        JSON lines; what is there is kept only by `append` after `read_journal`.
    """

    def __init__(self, file: Path) -> None:
        self.file = file

    def start(self, header: dict[str, Any], records: list[dict[str, Any]]) -> None:
        """Begin with these, all of them or nothing."""
        write_whole(self.file, "".join(_line(entry) for entry in (header, *records)))

    def append(self, record: dict[str, Any]) -> None:
        """Add a record; when this returns, it is on the disk."""
        with self.file.open("a") as stream:
            stream.write(_line(record))
            stream.flush()
            os.fsync(stream.fileno())


def read_journal(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Header and records; a last line that was cut off while it was written is left out.

    Raises
    ------
    SettingsError
        If the file has no header or a line is not JSON.
    """
    complete, _, _ = file.read_text().rpartition("\n")
    try:
        entries = [json.loads(line) for line in complete.splitlines()]
    except json.JSONDecodeError as error:
        raise SettingsError(f"{file}: not JSON lines: {error}; remove the file to start again") from error
    if not entries:
        raise SettingsError(f"{file}: is empty; remove the file to start again")
    return entries[0], entries[1:]


def write_whole(file: Path, text: str) -> None:
    """Replace a file's content, so that there is always the old or the new one."""
    file.parent.mkdir(parents=True, exist_ok=True)
    new = file.with_name(f".{file.name}.new")
    with new.open("w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    new.replace(file)


def _line(entry: dict[str, Any]) -> str:
    return json.dumps(entry, allow_nan=False) + "\n"
