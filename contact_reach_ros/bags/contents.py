"""What a recording keeps beside its messages, and whether the disk has room for it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import yaml

from contact_reach_ros.bags.settings import RecorderSettings, StorageSettings
from contact_reach_ros.errors import BagError
from contact_reach_ros.versions import git_revision, versions

MEGA = 1e6
"""Bytes in one MB."""


def custom_data_of(settings: RecorderSettings) -> dict[str, str]:
    """Text to keep in the bag, from the parameters and the files that they name.

    Raises `BagError` if an entry is not key=value, or a file cannot be read.
    """
    custom_data = dict(_key_and_value("custom_data", text) for text in settings.custom_data)
    for key, path in (_key_and_value("files", text) for text in settings.files):
        try:
            custom_data[key] = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise BagError(f"parameter files, entry '{key}': {path} cannot be read as text: {error}") from error
    return custom_data


def provenance(middleware: str) -> dict[str, str]:
    """The versions that recorded, as custom data."""
    revision = git_revision()
    made_by = {"versions": yaml.safe_dump({**versions(), "rmw": middleware})}
    return made_by if revision is None else {**made_by, "git_revision": revision}


def shortage_in(directory: Path, storage: StorageSettings) -> str:
    """Describe the shortage if the disk has less space than has to be left; else empty."""
    existing = directory.resolve()
    # Not Path.is_dir, which raises for a name that is too long.
    while not os.path.isdir(existing):
        existing = existing.parent
    free = shutil.disk_usage(existing).free / MEGA
    if free >= storage.min_free_mb:
        return ""
    return (
        f"{free:.0f} MB are free in {existing}, fewer than the {storage.min_free_mb:.0f} MB of storage.min_free_mb; "
        "make room, or record elsewhere"
    )


def _key_and_value(parameter: str, text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise BagError(f"parameter {parameter}, entry '{text}': expected key=value")
    return key, value
