"""Checks whether this machine can keep a 1 kHz loop."""

from __future__ import annotations

import gc
import os
import platform
import resource
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from contact_reach_ros.doctor.findings import Finding, check, graded, passed, warned
from contact_reach_ros.ros.scheduling import isolated_cpus
from contact_reach_ros.units import NANOSECONDS

PRIORITY = 80
"""SCHED_FIFO priority that is asked for: the highest of the nodes, the driver's."""

_TIMER_S = 2.0
_TICK_NS = 1_000_000
_GOOD_P99_US = 250.0
_GOOD_MISSED, _BAD_MISSED = 0.001, 0.05
_REPORTED_EVERY = 1000
_MANY_CORES = 4

_CONTAINERS = (Path("/.dockerenv"), Path("/run/.containerenv"))
_LIMITS = "/etc/security/limits.d/contact_reach.conf"


@check("real-time priority")
def realtime_permission() -> Finding:
    """Check whether threads may have SCHED_FIFO priority."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    refusals: list[str] = []
    # Of this short-lived thread only, which does nothing else.
    thread = threading.Thread(target=lambda: refusals.append(_become_realtime(PRIORITY)))
    thread.start()
    thread.join()
    if not refusals[0]:
        return passed(f"SCHED_FIFO {PRIORITY} granted (rtprio limit {limit})", granted=True, limit=limit)
    fix = (
        f'as root: printf "$USER - rtprio 90\\n$USER - memlock unlimited\\n" > {_LIMITS}, then log in again; memlock '
        "keeps the loops' memory from being swapped out"
    )
    if any(mark.exists() for mark in _CONTAINERS):
        fix = "start the container with --cap-add=sys_nice --ulimit rtprio=99 --ulimit memlock=-1"
    found = f"SCHED_FIFO {PRIORITY} refused ({refusals[0]}; rtprio limit {limit}): ticks are missed under load"
    return warned(found, fix, granted=False, limit=limit)


@check("processors")
def processors() -> Finding:
    """Check the number of cores that this process may use, and how busy they are."""
    cores, load, isolated = len(os.sched_getaffinity(0)), os.getloadavg()[0], isolated_cpus()
    found = f"{cores} cores, load {load:.1f} over the last minute"
    values = {"cores": cores, "load": load, "isolated": sorted(isolated)}
    if load > cores:
        fix = "end other busy programs (see top), or give the loops a core of their own with the parameter cpus"
        return warned(f"{found}: more work than cores", fix, **values)
    if isolated:
        return passed(f"{found}; CPU {max(isolated)} is kept for driver and controller by isolcpus", **values)
    if cores < _MANY_CORES:
        return warned(
            f"{found}: Linux stops the arm's loops for 50 ms when they fill 95 % of a core",
            "switch this throttling off or isolate a core, see docs/realtime.md, or use a machine with "
            f"{_MANY_CORES} cores",
            **values,
        )
    return passed(found, **values)


@check("timer at 1 kHz")
def timer_jitter(seconds: float = _TIMER_S) -> Finding:
    """Measure how late a 1 kHz timer wakes up over some seconds."""
    enabled = gc.isenabled()
    gc.disable()
    test = TimerTest(seconds)
    test.start()
    test.join()
    if enabled:
        gc.enable()
    p50, p99 = np.percentile(test.late_ns, [50, 99]) / 1000
    most, ticks = test.late_ns.max() / 1000, len(test.late_ns) + test.missed
    missed = test.missed / max(ticks, 1)
    how = "SCHED_FIFO" if test.realtime else "without real-time priority"
    return graded(
        f"late by p50 {p50:.0f}, p99 {p99:.0f}, max {most:.0f} us; missed {test.missed} of {ticks} ticks in "
        f"{seconds:g} s, {how}",
        "; ".join(late_wake_up_fixes(test.realtime)),
        fail=missed > _BAD_MISSED,
        warn=missed > _GOOD_MISSED or p99 > _GOOD_P99_US,
        p50_us=float(p50),
        p99_us=float(p99),
        max_us=float(most),
        missed=int(test.missed),
        missed_fraction=float(missed),
        realtime=test.realtime,
    )


def late_wake_up_fixes(
    realtime: bool,
    cpus: Path = Path("/sys/devices/system/cpu"),
    kernel: Path = Path("/sys/kernel/realtime"),
    version: str = "",
) -> list[str]:
    """List what helps against late wake-ups on this machine, most effective first.

    Parameters
    ----------
    realtime
        Whether threads may have SCHED_FIFO priority.
    cpus
        Folder in which Linux shows its CPUs.
    kernel
        File that only real-time kernels have.
    version
        Of the kernel; this machine's when empty.
    """
    fixes = [] if realtime else ["permit real-time priority (see above)"]
    fixes.append("end other busy programs (see top)")
    governors = {file.read_text().strip() for file in cpus.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    if governors - {"performance"}:
        fixes.append(f"sudo cpupower frequency-set -g performance (governor {', '.join(sorted(governors))} now)")
    if "PREEMPT_RT" not in (version or platform.version()) and not kernel.is_file():
        fixes.append("for a real arm install a PREEMPT_RT kernel (Ubuntu: sudo pro enable realtime-kernel)")
    return [*fixes, "turn deep idle states off"]


class TimerTest(threading.Thread):
    """Sleeps at 1 kHz for a while as the driver's loop does, with SCHED_FIFO priority where that is permitted.

    Parameters
    ----------
    seconds
        How long.
    priority
        Its priority.

    Attributes
    ----------
    late_ns
        (n,), delay of each wake-up, ns.
    missed
        Ticks that had passed before it woke up.
    realtime
        Whether it had SCHED_FIFO priority.
    """

    def __init__(self, seconds: float, priority: int = PRIORITY) -> None:
        super().__init__(name="timer test")
        self._priority = priority
        self.late_ns = np.zeros(int(seconds * NANOSECONDS / _TICK_NS), dtype=np.int64)
        self.missed = 0
        self.realtime = False

    def run(self) -> None:
        """Take all ticks; the thread only sleeps and notes the time."""
        self.realtime = not _become_realtime(self._priority)
        for tick, (late_ns, missed) in zip(range(len(self.late_ns)), _wake_ups(), strict=False):
            self.late_ns[tick] = late_ns
            self.missed += missed


def report_ticks(priority: int) -> None:
    """Sleep at 1 kHz until killed, and print every 1000 wake-ups how many ticks were due and how many were missed."""
    gc.disable()
    _become_realtime(priority)
    all_missed = 0
    for tick, (_, missed) in enumerate(_wake_ups(), start=1):
        all_missed += missed
        if tick % _REPORTED_EVERY == 0:
            print(tick + all_missed, all_missed, flush=True)


def _become_realtime(priority: int) -> str:
    """Give the calling thread SCHED_FIFO priority; returns why that is refused, else an empty text."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _wake_ups() -> Iterator[tuple[int, int]]:
    """Sleep until the next millisecond each time; yields the delay, ns, and how many ticks had passed by then."""
    due_ns = time.monotonic_ns() + _TICK_NS
    while True:
        left_ns = due_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns / NANOSECONDS)
        late_ns = time.monotonic_ns() - due_ns
        missed = max(late_ns, 0) // _TICK_NS
        yield late_ns, missed
        due_ns += (1 + missed) * _TICK_NS


if __name__ == "__main__":
    report_ticks(int(sys.argv[1]))
