"""Checks whether this machine can keep a 1 kHz loop."""

from __future__ import annotations

import gc
import os
import resource
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.doctor.findings import Finding, graded
from contact_reach_ros.timing import NANOSECONDS, Pace

PRIORITY = 80
"""SCHED_FIFO priority that is asked for: the highest of the nodes, the driver's."""

_LIMITS = "/etc/security/limits.d/contact_reach.conf"
_TICK_NS = 1_000_000
_GOOD_P99_US = 250.0
_GOOD_MISSED, _BAD_MISSED = 0.001, 0.05


def timer_jitter(seconds: float = 2.0) -> Finding:
    """Measure how late a 1 kHz timer wakes up over some seconds, with SCHED_FIFO priority where that is permitted."""
    enabled = gc.isenabled()
    gc.disable()
    # The thread alone gets the priority, and ends.
    with ThreadPoolExecutor(1) as thread:
        refusal = thread.submit(_become_realtime).result()
        late_us, missed = thread.submit(_sleep, round(seconds * NANOSECONDS / _TICK_NS)).result()
    if enabled:
        gc.enable()
    p50, p99 = np.percentile(late_us, [50, 99])
    most, ticks = late_us.max(), len(late_us) + missed
    priority, fix = f"SCHED_FIFO {PRIORITY}", ""
    if refusal:
        limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
        priority = f"without real-time priority ({refusal}; rtprio limit {limit}): ticks are missed under load"
        fix = (
            f'as root: printf "$USER - rtprio 90\\n$USER - memlock unlimited\\n" > {_LIMITS}, then log in again, or '
            "start the container with --cap-add=sys_nice --ulimit rtprio=99 --ulimit memlock=-1; "
        )
    fix += (
        "end other busy programs (see top), set the CPU governor (sudo cpupower frequency-set -g performance); for a "
        "real arm install a PREEMPT_RT kernel: docs/realtime.md"
    )
    return graded(
        f"late by p50 {p50:.0f}, p99 {p99:.0f}, max {most:.0f} us; missed {missed} of {ticks} ticks; load "
        f"{os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} cores; {priority}",
        fix,
        fail=missed / ticks > _BAD_MISSED,
        warn=bool(refusal) or missed / ticks > _GOOD_MISSED or p99 > _GOOD_P99_US,
    )


def _become_realtime() -> str:
    """Give the calling thread SCHED_FIFO priority; returns why that is refused, else an empty text."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _sleep(count: int) -> tuple[Array, int]:
    """Wake up at `count` ticks; returns how late, (count,), us, and the number of other ticks that passed meanwhile."""
    late_ns, pace = [], Pace(_TICK_NS)
    pace.start(time.monotonic_ns())
    for _ in range(count):
        time.sleep(max(pace.next_ns - time.monotonic_ns(), 0) / NANOSECONDS)
        now_ns = time.monotonic_ns()
        late_ns.append(now_ns - pace.next_ns)
        pace.due(now_ns)
    return np.array(late_ns) / 1000.0, pace.missed
