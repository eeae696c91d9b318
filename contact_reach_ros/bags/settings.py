"""Settings of the recorder."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from contact_reach_ros.errors import BagError
from contact_reach_ros.settings import Sections, Settings, setting

MEGA = 1e6
"""Bytes in one MB."""
LEAST_FREE_MB = 500.0
"""Space on the disk that is left to others, MB: ten minutes of the stack are about as much, and the system and other
nodes need room for their logs."""


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """Contents of the bag, and its place."""

    bag: str = setting("", "directory to create; named after date and time when empty, never overwritten")
    custom_data: tuple[str, ...] = setting((), "key=value each: text to keep in the bag, such as scene and seed")
    files: tuple[str, ...] = setting((), "key=path each: text files to keep in the bag, such as the parameter file")

    def texts(self) -> dict[str, str]:
        """Return the text to keep in the bag, by key.

        Raises `BagError` if an entry is not key=value, or a file cannot be read.
        """
        texts = dict(_key_and_value("custom_data", entry) for entry in self.custom_data)
        for key, path in (_key_and_value("files", entry) for entry in self.files):
            try:
                texts[key] = Path(path).read_text(encoding="utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise BagError(f"parameter files, entry '{key}': {path} cannot be read as text: {error}") from error
        return texts


RECORDER_SECTIONS: Sections = {"": RecorderSettings}
"""Settings of the recorder by parameter prefix."""


def shortage_in(directory: Path) -> str:
    """Describe the shortage if the disk of a directory has less free space than is left to others; else empty."""
    existing = directory.resolve()
    # Not Path.is_dir, which raises for a name that is too long.
    while not os.path.isdir(existing):
        existing = existing.parent
    free = shutil.disk_usage(existing).free / MEGA
    if free >= LEAST_FREE_MB:
        return ""
    return (
        f"{free:.0f} MB are free in {existing}, fewer than the {LEAST_FREE_MB:.0f} MB that are left to others; "
        "make room, or record elsewhere"
    )


def _key_and_value(parameter: str, text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise BagError(f"parameter {parameter}, entry '{text}': expected key=value")
    return key, value
