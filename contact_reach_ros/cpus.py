"""Which CPUs the kernel keeps free of what does not ask for them."""

from __future__ import annotations

from pathlib import Path


def isolated_cpus(file: Path = Path("/sys/devices/system/cpu/isolated")) -> set[int]:
    """CPUs that the kernel was told to keep free, by isolcpus on its command line."""
    try:
        ranges = [part.split("-") for part in file.read_text().strip().split(",") if part]
    except OSError:
        return set()
    return {cpu for ends in ranges for cpu in range(int(ends[0]), int(ends[-1]) + 1)}
