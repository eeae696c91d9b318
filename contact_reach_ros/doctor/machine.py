"""Checks whether this machine can keep a 1 kHz loop."""

from __future__ import annotations

import gc
import itertools
import os
import resource
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.doctor.findings import Finding, graded, passed
from contact_reach_ros.timing import NANOSECONDS

PRIORITY = 80
"""SCHED_FIFO priority that is asked for: the highest of the nodes, the driver's."""

_TICK_NS = 1_000_000
_GOOD_P99_US = 250.0
_GOOD_MISSED, _BAD_MISSED = 0.001, 0.05
_REPORTED_EVERY = 1000

_CONTAINERS = (Path("/.dockerenv"), Path("/run/.containerenv"))


def realtime_permission() -> Finding:
    """Check whether threads may have SCHED_FIFO priority."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    with ThreadPoolExecutor(1) as thread:
        # Of this short-lived thread only, which does nothing else.
        refusal = thread.submit(_become_realtime, PRIORITY).result()
    if not refusal:
        return passed(f"SCHED_FIFO {PRIORITY} granted (rtprio limit {limit})", granted=True, limit=limit)
    limits = "/etc/security/limits.d/contact_reach.conf"
    fix = f'as root: printf "$USER - rtprio 90\\n$USER - memlock unlimited\\n" > {limits}, then log in again'
    if any(mark.exists() for mark in _CONTAINERS):
        fix = "start the container with --cap-add=sys_nice --ulimit rtprio=99 --ulimit memlock=-1"
    found = f"SCHED_FIFO {PRIORITY} refused ({refusal}; rtprio limit {limit}): ticks are missed under load"
    return graded(found, fix, warn=True, granted=False, limit=limit)


def timer_jitter(seconds: float = 2.0) -> Finding:
    """Measure how late a 1 kHz timer wakes up over some seconds, with SCHED_FIFO priority where that is permitted."""
    enabled = gc.isenabled()
    gc.disable()
    with ThreadPoolExecutor(1) as thread:
        realtime = not thread.submit(_become_realtime, PRIORITY).result()
        late_us, missed = thread.submit(_sleep, round(seconds * NANOSECONDS / _TICK_NS)).result()
    if enabled:
        gc.enable()
    p50, p99 = np.percentile(late_us, [50, 99])
    most, ticks = late_us.max(), len(late_us) + missed
    fix = "" if realtime else "permit real-time priority (see above), "
    fix += (
        "end other busy programs (see top), set the CPU governor (sudo cpupower frequency-set -g performance); for a "
        "real arm install a PREEMPT_RT kernel: docs/realtime.md"
    )
    return graded(
        f"late by p50 {p50:.0f}, p99 {p99:.0f}, max {most:.0f} us; missed {missed} of {ticks} ticks, "
        f"{'SCHED_FIFO' if realtime else 'without real-time priority'}; load {os.getloadavg()[0]:.1f} on "
        f"{len(os.sched_getaffinity(0))} cores",
        fix,
        fail=missed / ticks > _BAD_MISSED,
        warn=missed / ticks > _GOOD_MISSED or p99 > _GOOD_P99_US,
        p50_us=float(p50),
        p99_us=float(p99),
        max_us=float(most),
        missed=missed,
        missed_fraction=missed / ticks,
        realtime=realtime,
    )


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


def _sleep(count: int) -> tuple[Array, int]:
    """Take the delays (count,), us, of wake-ups, and the number of ticks that had passed before one."""
    wake_ups = np.array(list(itertools.islice(_wake_ups(), count)))
    return wake_ups[:, 0] / 1000.0, int(wake_ups[:, 1].sum())


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
