"""Settings of the recorder."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.bags.writer import COMPRESSIONS
from contact_reach_ros.settings import Sections, Settings, setting


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """Contents of the bag, and its place."""

    bag: str = setting("", "directory to create; named after date and time when empty, never overwritten")
    topics: tuple[str, ...] = setting((), "name or name:package/msg/Type each; everything of the stack when empty")
    custom_data: tuple[str, ...] = setting((), "key=value each: text to keep in the bag, such as scene and seed")
    files: tuple[str, ...] = setting((), "key=path each: text files to keep in the bag, such as the parameter file")
    lockstep: bool = setting(False, "let simulated time wait for the recorder; the driver's `waits_for` has to name it")


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


RECORDER_SECTIONS: Sections = {"": RecorderSettings, "storage": StorageSettings}
"""Settings of the recorder by parameter prefix."""
