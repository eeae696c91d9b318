"""Running many independent tasks: in processes of this machine, or on the workers of a Dask scheduler."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from multiprocessing import connection
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from contact_reach_ros.errors import SettingsError

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

_SCHEDULER_TIMEOUT = "10s"


class Crew(Protocol):
    """Workers behind the interface of `concurrent.futures`; leaving the context ends them."""

    size: int
    """Tasks that can run at the same time."""
    executor: Executor

    def restart(self) -> None:
        """Replace workers that have died."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: Any) -> None: ...


class ProcessCrew:
    """Processes of this machine, started afresh rather than forked, since JAX has threads.

    Parameters
    ----------
    size
        Number of processes.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._others = set(multiprocessing.active_children())
        self.executor: Executor = self._start()

    def restart(self) -> None:
        """Replace all processes; tasks that were not finished are lost."""
        self._end()
        self.executor = self._start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            self.executor.shutdown()
        else:
            self._end()

    def _start(self) -> Executor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self.size, mp_context=context, initializer=_prepare_process)

    def _end(self) -> None:
        """Without waiting for the tasks at hand."""
        children = [child for child in multiprocessing.active_children() if child not in self._others]
        self.executor.shutdown(wait=False, cancel_futures=True)
        for child in children:
            child.kill()
        for child in children:
            child.join()


class DaskCrew:
    """The workers of a Dask scheduler, which need this package installed.

    Parameters
    ----------
    address
        Of the scheduler, such as tcp://host:8786.

    Raises
    ------
    SettingsError
        If the package `distributed` is missing, nobody answers at the address, or there are no workers.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise SettingsError(
                f"scheduler '{address}': the Python package 'distributed' is missing; install it with "
                "pip install 'contact_reach_ros[dask]', here and on the workers"
            ) from error
        try:
            self._client = Client(address, timeout=_SCHEDULER_TIMEOUT)
        except (OSError, ValueError) as error:
            raise SettingsError(
                f"scheduler '{address}': no Dask scheduler answers there ({error}); expected an address such as "
                "tcp://host:8786 of one that `dask scheduler` started"
            ) from error
        self.size = sum(self._client.nthreads().values())
        if self.size == 0:
            self._client.close()
            raise SettingsError(
                f"scheduler '{address}': it has no workers; start some with `dask worker {address} --nthreads 1`"
            )
        self.executor: Executor = self._client.get_executor()

    def restart(self) -> None:
        """Dask's own affair."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        # Dask's executor cancels what is not finished when it is not to wait.
        self.executor.shutdown(wait=kind is None)
        self._client.close()


def run_all(
    crew: Crew, function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]
) -> Iterator[tuple[TaskT, ResultT | BaseException]]:
    """Yield each task with its result, or with the error that it ended in, as they come.

    When a process dies, the tasks that were running are run again one at a time, so that only the one to blame fails.
    """
    waiting, suspects = deque(tasks), deque[TaskT]()
    running: dict[Future[ResultT], TaskT] = {}
    while waiting or suspects or running:
        broken = []
        try:
            while len(running) < (1 if suspects else crew.size) and (suspects or waiting):
                queue = suspects or waiting
                future = crew.executor.submit(function, queue[0])
                running[future] = queue.popleft()
                if queue is suspects:
                    break
        except BrokenExecutor:
            if not running:
                crew.restart()
                continue
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        if any(isinstance(future.exception(), BrokenExecutor) for future in done):
            done, _ = wait(running)
        for future in done:
            task, error = running.pop(future), future.exception()
            if isinstance(error, BrokenExecutor):
                broken.append(task)
            else:
                yield task, error or future.result()
        if broken:
            crew.restart()
        if len(broken) == 1:
            yield broken[0], RuntimeError("the worker's process died")
        else:
            suspects.extend(broken)


def _prepare_process() -> None:
    """Ctrl-C reaches every process of the terminal: the first one ends the others, and they end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
