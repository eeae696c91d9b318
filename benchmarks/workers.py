"""Runs many independent tasks on processes of this machine, which end with this one."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.executables import end_with_parent

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")


def run_each(
    function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT], count: int | None = None
) -> Iterator[ResultT]:
    """Run tasks on `count` processes, at least one and by default one per core; yields the results as they come.

    Raises
    ------
    ContactReachError
        If a process dies, as where memory runs out. Any error of a task is raised as it is.
    """
    # Spawned, since JAX's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(count or os.cpu_count(), context, _begin)
    try:
        for future in as_completed([executor.submit(function, task) for task in tasks]):
            yield future.result()
        executor.shutdown()
    except BrokenProcessPool as error:
        raise ContactReachError(
            "a worker's process died, perhaps for lack of memory: run the same command with fewer --workers"
        ) from error
    finally:
        # After an error or an interruption nothing of what still runs is wanted.
        executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()


def _begin() -> None:
    """Let a worker go on at Ctrl-C, which reaches all processes of a terminal: the one that started it ends it."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
