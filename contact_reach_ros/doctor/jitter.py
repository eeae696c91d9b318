"""How late a thread wakes up that sleeps until the next millisecond, as the driver's loop does."""

from __future__ import annotations

import gc
import itertools
import os
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np

from contact_reach_ros.doctor.findings import Finding, failed, passed, warned
from contact_reach_ros.doctor.machine import PRIORITY
from contact_reach_ros.units import NANOSECONDS

_TICK_NS = 1_000_000
_GOOD_P99_US = 250.0
_GOOD_MISSED, _BAD_MISSED = 0.001, 0.05
_TOLD_EVERY = 1000


class TimerTest(threading.Thread):
    """Sleeps at 1 kHz for a while, with SCHED_FIFO priority where that is permitted.

    Parameters
    ----------
    seconds
        How long.
    priority
        Its priority.

    Attributes
    ----------
    late_ns
        (n,), how much later than asked for the thread woke up, ns.
    missed
        Ticks that were over before it woke up.
    realtime
        Whether it had SCHED_FIFO priority.
    """

    def __init__(self, seconds: float, priority: int = PRIORITY) -> None:
        super().__init__(name="timer test")
        self._priority = priority
        self._ticks = int(seconds * NANOSECONDS / _TICK_NS)
        self.late_ns = np.zeros(self._ticks, dtype=np.int64)
        self.missed = 0
        self.realtime = False

    @property
    def missed_fraction(self) -> float:
        """Of all ticks, those that were missed."""
        return self.missed / max(len(self.late_ns) + self.missed, 1)

    def run(self) -> None:
        """Take all ticks; the thread does nothing but sleep and write down the time."""
        self.realtime = _become_realtime(self._priority)
        for tick, (late_ns, missed) in enumerate(itertools.islice(_wake_ups(), self._ticks)):
            self.late_ns[tick] = late_ns
            self.missed += missed


def count_for_others() -> None:
    """Sleep at 1 kHz until the process is ended, for a program that is busy itself and reads the output.

    Each second a line is written: how many ticks were due so far, and how many of these were missed. The only argument
    is the priority.
    """
    gc.disable()
    _become_realtime(int(sys.argv[1]))
    all_missed = 0
    for tick, (_, missed) in enumerate(_wake_ups(), start=1):
        all_missed += missed
        if tick % _TOLD_EVERY == 0:
            print(tick + all_missed, all_missed, flush=True)


def _become_realtime(priority: int) -> bool:
    """Give the calling thread SCHED_FIFO priority; returns whether that is permitted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    return True


def _wake_ups() -> Iterator[tuple[int, int]]:
    """Sleep until the next millisecond each time: how late it was, ns, and how many ticks were over by then."""
    due_ns = time.monotonic_ns() + _TICK_NS
    while True:
        left_ns = due_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns / NANOSECONDS)
        late_ns = time.monotonic_ns() - due_ns
        missed = max(late_ns, 0) // _TICK_NS
        yield late_ns, missed
        due_ns += (1 + missed) * _TICK_NS


def timer_jitter(seconds: float) -> Finding:
    """Wake-up lateness of a 1 kHz timer over some seconds."""
    name = "timer at 1 kHz"
    enabled = gc.isenabled()
    gc.disable()
    test = TimerTest(seconds)
    test.start()
    test.join()
    if enabled:
        gc.enable()
    p50, p99 = np.percentile(test.late_ns, [50, 99]) / 1000
    most, missed = test.late_ns.max() / 1000, test.missed_fraction
    how = "SCHED_FIFO" if test.realtime else "without real-time priority"
    found = (
        f"late by p50 {p50:.0f}, p99 {p99:.0f}, max {most:.0f} us; missed {test.missed} of "
        f"{len(test.late_ns) + test.missed} ticks in {seconds:g} s, {how}"
    )
    values = {
        "p50_us": float(p50),
        "p99_us": float(p99),
        "max_us": float(most),
        "missed": int(test.missed),
        "missed_fraction": float(missed),
        "realtime": test.realtime,
    }
    fix = "end what else computes, set the governor 'performance', turn deep idle states off, use a PREEMPT_RT kernel"
    if not test.realtime:
        fix = "permit real-time priority (see above), then " + fix
    if missed > _BAD_MISSED:
        return failed(name, found, fix, **values)
    if missed > _GOOD_MISSED or p99 > _GOOD_P99_US:
        return warned(name, found, fix, **values)
    return passed(name, found, **values)


if __name__ == "__main__":
    count_for_others()
