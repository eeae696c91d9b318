"""What a benchmark ran on."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from contact_reach_ros.versions import versions


def machine() -> dict[str, object]:
    """Processor, cores, load and versions, for reports."""
    return {
        "cpu": _processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        **versions(),
    }


def _processor() -> str:
    """Name of the processor, as Linux knows it."""
    information = Path("/proc/cpuinfo")
    for line in information.read_text().splitlines() if information.is_file() else []:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
