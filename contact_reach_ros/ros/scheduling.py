"""Which CPUs, priorities and memory the processes of the stack get from Linux."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
from collections.abc import Callable, Collection, Sequence
from enum import Enum
from pathlib import Path

from contact_reach_ros.errors import SettingsError

_THREADS = Path("/proc/self/task")

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
"""Flags of mlockall(2)."""

_SERVICES_PRIORITY = 50
_COMPUTING_NICENESS = -5
_FEW_CPUS = 3


class Role(Enum):
    """Node of a process, by its name: it decides who may interrupt the process, and where it runs.

    The value is the SCHED_FIFO priority. A node must not preempt those whose messages it waits for, but a controller
    that never sleeps must not keep the adapter from noticing its silence.
    """

    DRIVER = 80
    ADAPTER = 75
    CONTROLLER = 70
    OBSERVER = 60
    """Keeps pace with the control loop, which does not wait for it."""
    PLANNER = 30
    """Computes for long: of its threads the middleware's alone, to pass messages on meanwhile."""
    RECORDER = 20
    """Nobody waits for it, but it must not miss messages."""
    VIEWER = 0
    """Nobody waits for it, and it may miss messages: it has no priority."""


_CONTROL_LOOP = (Role.DRIVER, Role.ADAPTER, Role.CONTROLLER)


def choose_cpus(wanted: str, role: Role, permitted: Collection[int]) -> set[int]:
    """Choose the CPUs for the threads of a process.

    On two or three CPUs the control loop has the last one, so that its messages find their receivers without waking
    another CPU, and all processes but the viewer have the others. Raises `SettingsError` if `wanted` is none of these.

    Parameters
    ----------
    wanted
        'auto' for the above, 'all', or numbers separated by commas, also of CPUs that the kernel isolates.
    role
        Of the process.
    permitted
        CPUs that the kernel gives to the process by itself.
    """
    if wanted == "auto" and role is not Role.VIEWER and 2 <= len(permitted) <= _FEW_CPUS:
        last = {max(permitted)}
        return last if role in _CONTROL_LOOP else set(permitted) - last
    if wanted in ("auto", "all"):
        return set(permitted)
    numbers = [int(text) if text.strip().isdecimal() else -1 for text in wanted.split(",")]
    if not all(0 <= number < (os.cpu_count() or 1) for number in numbers):
        raise SettingsError(f"parameter cpus: '{wanted}'; expected auto, all, or numbers below {os.cpu_count()}")
    return set(numbers)


def use_cpus(cpus: Collection[int]) -> None:
    """Run all threads of this process, and those started later, on these CPUs only."""
    _for_each(_threads(), lambda thread: os.sched_setaffinity(thread, cpus))


def take_priority(role: Role) -> str:
    """Give a process that is ready, and keeps real time, the priorities of its role.

    All threads get it, the middleware's included, which bring the messages; in a process at 1 kHz garbage is not
    collected any more. Returns a warning for the log that explains how to permit it; empty when granted.
    """
    if role is Role.OBSERVER or role in _CONTROL_LOOP:
        gc.collect()
        gc.freeze()
        gc.disable()
        # Pages in use stay in memory. Where that is not permitted the loop still works, with a late tick now and then.
        ctypes.CDLL(None).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    if role is Role.PLANNER:
        # Beside two busy programs the arm reached 63 goals in 330 s with this, 54 in 600 s without.
        with contextlib.suppress(OSError):
            _for_each(_threads(), lambda thread: os.setpriority(os.PRIO_PROCESS, thread, _COMPUTING_NICENESS))
            if os.getsid(0) == os.getpid():
                # Where Linux divides its time by sessions, niceness counts only within one.
                Path("/proc/self/autogroup").write_text(str(_COMPUTING_NICENESS))
        return prioritise_middleware()
    # Programs that are not part of the stack cannot delay the recorder then; it sleeps most of the time.
    return "" if role is Role.VIEWER else _prioritise(_threads(), role.value)


def prioritise_middleware() -> str:
    """Give the middleware's threads SCHED_FIFO priority below all loops, as messages would wait for a computation.

    Returns what `take_priority` does.
    """
    return _prioritise([thread for thread in _threads() if _name(thread).startswith("dds.")], Role.PLANNER.value)


def give_way() -> None:
    """Lower the calling thread's SCHED_FIFO priority, if it has any, below that of every loop of the stack.

    For services and diagnostics, which would delay each loop on the same CPU: Linux does not preempt a thread for
    another of the same priority.
    """
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        priority = min(os.sched_getparam(0).sched_priority - 1, _SERVICES_PRIORITY)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def _threads() -> list[int]:
    """Ids of all threads of this process, those of the middleware included."""
    return [int(thread.name) for thread in _THREADS.iterdir()]


def _name(thread: int) -> str:
    """Name of a thread; empty if it has ended."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return (_THREADS / str(thread) / "comm").read_text()
    return ""


def _for_each(threads: Collection[int], arrange: Callable[[int], None]) -> None:
    """Arrange something for each of these threads, of which some may have ended since they were listed."""
    for thread in threads:
        with contextlib.suppress(ProcessLookupError):
            arrange(thread)


def _prioritise(threads: Sequence[int], priority: int) -> str:
    try:
        _for_each(threads, lambda thread: os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority)))
    except PermissionError:
        return (
            "no real-time priority: ticks will be missed when the machine is busy. Permit it with "
            "'rtprio 90' for your user in /etc/security/limits.d/, then log in again"
        )
    return ""
