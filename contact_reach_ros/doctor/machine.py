"""Whether this machine can keep a 1 kHz loop."""

from __future__ import annotations

import os
import platform
import re
import resource
import shutil
import threading
from collections.abc import Collection
from pathlib import Path

from contact_reach_ros.cpus import isolated_cpus
from contact_reach_ros.doctor.findings import Finding, failed, passed, warned

PRIORITY = 80
"""SCHED_FIFO priority that is asked for: the highest of the nodes, the driver's."""

TYPICAL_BAG_RATE = 0.4e6
"""Of a whole stack in real time, compressed, bytes/s."""

_CAP_IPC_LOCK = 14
_MANY_CORES = 4
_ENOUGH_MEMORY = 4 * 2**30
_MINUTE = 60.0
_FAIR_SERVER = (6, 12)
_SERVERS = Path("/sys/kernel/debug/sched/fair_server")
_SERVED_BY_DEFAULT = (50.0, 1000.0)
"""Time of a fair server and its period, ms."""
_LITTLE_DISK, _FEW_MINUTES = 1e9, 10.0

_CONTAINERS = (Path("/.dockerenv"), Path("/run/.containerenv"))
_LIMITS = "/etc/security/limits.d/"


def realtime_permission() -> Finding:
    """Whether threads may have SCHED_FIFO priority."""
    name = "real-time priority"
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    refusal: list[OSError] = []

    def ask() -> None:
        # Of this short-lived thread only, which does nothing else.
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        except OSError as error:
            refusal.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    if not refusal:
        return passed(name, f"SCHED_FIFO {PRIORITY} granted (rtprio limit {limit})", granted=True, limit=limit)
    fix = f'as root: echo "$USER - rtprio 90" > {_LIMITS}rtprio.conf, then log in again'
    if any(mark.exists() for mark in _CONTAINERS):
        fix = "start the container with --cap-add=sys_nice --ulimit rtprio=99"
    found = f"SCHED_FIFO {PRIORITY} refused ({refusal[0].strerror}; rtprio limit {limit}): ticks are missed under load"
    return warned(name, found, fix, granted=False, limit=limit)


def memory_lock() -> Finding:
    """Whether the nodes may keep their memory from being swapped out."""
    name = "locked memory"
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if _capable(_CAP_IPC_LOCK) or limit == resource.RLIM_INFINITY:
        return passed(name, "unlimited")
    words = f"limit {limit / 2**20:.0f} MiB"
    if limit >= _ENOUGH_MEMORY:
        return passed(name, words)
    fix = f'as root: echo "$USER - memlock unlimited" > {_LIMITS}memlock.conf, then log in again'
    return warned(name, f"{words}: pages of the loops may be swapped out", fix)


def _capable(capability: int) -> bool:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> capability & 1)
    return False


def processors() -> Finding:
    """Cores that this process may use, and how busy they are."""
    name = "processors"
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    found = f"{cores} cores, load {load:.1f} over the last minute"
    values = {"cores": cores, "load": load}
    if cores < 2:
        fix = "use a machine with two cores or more, or set planning.deadline and period so that plans leave time"
        return warned(name, f"{found}: the planner takes the loops' core", fix, **values)
    if load > cores:
        fix = "end what else computes (see top), or give the loops a core of their own with the parameter cpus"
        return warned(name, f"{found}: more work than cores", fix, **values)
    return passed(name, found, **values)


def frequency_scaling(devices: Path = Path("/sys/devices/system/cpu")) -> Finding:
    """Whether cores slow down when they are idle, and take long to speed up."""
    name = "frequency scaling"
    governors = {file.read_text().strip() for file in devices.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    if not governors:
        return passed(name, "none that this system shows, as in most virtual machines")
    found = f"governor {', '.join(sorted(governors))}"
    if governors == {"performance"}:
        return passed(name, found)
    return warned(name, f"{found}: wake-ups are late", "sudo cpupower frequency-set -g performance")


def kernel(realtime: Path = Path("/sys/kernel/realtime"), version: str = "") -> Finding:
    """Whether the kernel is a real-time one."""
    name = "kernel"
    version = version or platform.version()
    release = platform.release()
    if "PREEMPT_RT" in version or (realtime.is_file() and realtime.read_text().strip() == "1"):
        return passed(name, f"{release}, PREEMPT_RT")
    fix = (
        "for a real arm install a PREEMPT_RT kernel (Ubuntu: sudo pro enable realtime-kernel); simulation runs without"
    )
    return warned(name, f"{release}, without PREEMPT_RT: rare late wake-ups of milliseconds are possible", fix)


def realtime_throttling(
    settings: Path = Path("/proc/sys/kernel"),
    cores: int | None = None,
    release: str = "",
    servers: Path = _SERVERS,
    isolated: Collection[int] | None = None,
) -> Finding:
    """Whether Linux stops real-time threads that take most of a CPU, which on few of them the loops may.

    Up to Linux 6.11 a sysctl says how much of each CPU they may take; from 6.12 on a fair server on each CPU gives that
    time to ordinary programs that wait, and the sysctl does nothing any more.
    """
    name = "real-time throttling"
    release = release or platform.release()
    served = _version(release) >= _FAIR_SERVER
    times = _fair_server_times(servers) if served else _throttling_times(settings)
    if times is None and not served:
        return passed(name, "not shown by this system")
    if times is not None and times[0] <= 0.0:
        return passed(name, "off")
    isolated = isolated_cpus() if isolated is None else isolated
    if served and isolated:
        return passed(name, f"none on CPU {max(isolated)}, which isolcpus keeps for driver and controller")
    cores = len(os.sched_getaffinity(0)) if cores is None else cores
    kept, period = times or _SERVED_BY_DEFAULT
    found = f"{kept:.0f} ms in {period:.0f} ms are kept from real-time threads"
    if served:
        found += " where ordinary programs wait" if times else " where ordinary programs wait, unless that is changed"
    if cores >= _MANY_CORES:
        return passed(name, f"{found}: on {cores} cores the loops never take so much of one")
    fix = "sudo sysctl kernel.sched_rt_runtime_us=-1: all real-time threads of the stack sleep between their ticks"
    if served:
        fix = f"sudo sh -c 'for f in {servers}/cpu*/runtime; do echo 0 > $f; done'"
        if cores > 1:
            fix += (
                f"; where the kernel is locked down, boot with isolcpus={cores - 1}: "
                "driver and controller have that CPU to themselves then"
            )
    return warned(name, f"{found}; on {cores} core(s) a slow phase of the machine then stops the arm's loops", fix)


def _version(release: str) -> tuple[int, int]:
    found = re.match(r"(\d+)\.(\d+)", release)
    return (int(found[1]), int(found[2])) if found else (0, 0)


def _throttling_times(settings: Path) -> tuple[float, float] | None:
    """What the sysctl keeps from real-time threads, ms, and in which time; None where it is not shown."""
    try:
        runtime, period = (int((settings / f"sched_rt_{part}_us").read_text()) for part in ("runtime", "period"))
    except (OSError, ValueError):
        return None
    return (0.0 if runtime < 0 else (period - runtime) / 1e3), period / 1e3


def _fair_server_times(servers: Path) -> tuple[float, float] | None:
    """The most that a CPU's fair server takes, ms, and in which time; None where only root may look."""
    try:
        times = [
            (int((server / "runtime").read_text()) / 1e6, int((server / "period").read_text()) / 1e6)
            for server in servers.iterdir()
        ]
    except (OSError, ValueError):
        return None
    return max(times, default=None)


def disk(folder: Path, rate: float | None = None) -> Finding:
    """Room for bags.

    Parameters
    ----------
    folder
        Where bags go.
    rate
        Measured size of a bag over time, bytes/s; the usual one when None.
    """
    name = "disk for bags"
    existing = folder.resolve()
    while not existing.is_dir():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    minutes = free / (rate or TYPICAL_BAG_RATE) / _MINUTE
    how = "at the rate measured now" if rate else "at the usual rate"
    found = f"{free / 1e9:.1f} GB free in {existing}, {minutes:,.0f} minutes of recording {how}"
    values = {"free_gb": free / 1e9, "minutes": minutes, "measured": rate is not None}
    fix = f"make room in {existing}, or let bags go elsewhere (parameter bag, demo --output)"
    if not os.access(existing, os.W_OK):
        return failed(name, f"{existing} cannot be written", fix, **values)
    if free < _LITTLE_DISK / 10 or minutes < 1.0:
        return failed(name, found, fix, **values)
    if free < _LITTLE_DISK or minutes < _FEW_MINUTES:
        return warned(name, found, fix, **values)
    return passed(name, found, **values)
