"""Settings of the recorder."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from contact_reach_ros.bags.writer import COMPRESSIONS
from contact_reach_ros.errors import BagError
from contact_reach_ros.settings import Sections, Settings, setting

MEGA = 1e6
"""Bytes in one MB."""


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """Contents of the bag, and its place."""

    bag: str = setting("", "directory to create; named after date and time when empty, never overwritten")
    topics: tuple[str, ...] = setting((), "names; every topic of the stack when empty")
    custom_data: tuple[str, ...] = setting((), "key=value each: text to keep in the bag, such as scene and seed")
    files: tuple[str, ...] = setting((), "key=path each: text files to keep in the bag, such as the parameter file")
    lockstep: bool = setting(False, "let simulated time wait for the recorder; the driver's `waits_for` has to name it")

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


@dataclass(frozen=True)
class StorageSettings(Settings):
    """Compression, splitting and free space."""

    compression: str = setting(
        "zstd", "compression of the file's chunks: half the size for a tenth more work", choices=tuple(COMPRESSIONS)
    )
    split_mb: float = setting(0.0, "size at which another file is begun; 0: never", unit="MB", minimum=0.0)
    split_s: float = setting(0.0, "time after which another file is begun; 0: never", unit="s", minimum=0.0)
    min_free_mb: float = setting(
        500.0, "space that is left to others: with less the bag is completed, or not begun", unit="MB", minimum=0.0
    )

    def shortage_in(self, directory: Path) -> str:
        """Describe the shortage if the disk of a directory has less free space than is left to others; else empty."""
        existing = directory.resolve()
        # Not Path.is_dir, which raises for a name that is too long.
        while not os.path.isdir(existing):
            existing = existing.parent
        free = shutil.disk_usage(existing).free / MEGA
        if free >= self.min_free_mb:
            return ""
        return (
            f"{free:.0f} MB are free in {existing}, fewer than the {self.min_free_mb:.0f} MB of storage.min_free_mb; "
            "make room, or record elsewhere"
        )


RECORDER_SECTIONS: Sections = {"": RecorderSettings, "storage": StorageSettings}
"""Settings of the recorder by parameter prefix."""


def _key_and_value(parameter: str, text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise BagError(f"parameter {parameter}, entry '{text}': expected key=value")
    return key, value
