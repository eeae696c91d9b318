"""What a benchmark ran on, and other programs that keep it busy."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from contact_reach_ros.versions import versions

_HOG = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(1000000))"


def machine() -> dict[str, object]:
    """Processor, cores, load and versions, for reports."""
    return {
        "cpu": _processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        **versions(),
    }


@contextmanager
def hogs(count: int) -> Iterator[None]:
    """Processes that take all the time they get; they end with this one."""
    command = [sys.executable, "-c", _HOG]
    processes = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def memory_mb(process: int, field: str) -> float:
    """Memory of a process, MB: VmRSS for what is in use, VmHWM for the most that was."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024 / 1e6
    return float("nan")


def _processor() -> str:
    """Name of the processor, as Linux knows it."""
    information = Path("/proc/cpuinfo")
    for line in information.read_text().splitlines() if information.is_file() else []:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
