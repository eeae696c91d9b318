"""Runs many independent tasks on Dask workers: processes of this machine, or those of a scheduler elsewhere."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from contact_reach_ros.errors import SettingsError

if TYPE_CHECKING:
    from distributed import Client, Future

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

_SCHEDULER_TIMEOUT = "10s"

_LOCAL = {
    # Latencies are measured in the workers: no sampling of their stacks, and few wake-ups of their event loops.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    # A worker that keeps the interpreter busy is at work, not dead.
    "distributed.scheduler.worker-ttl": None,
    # Tasks of a worker that died are run again by `run_all`.
    "distributed.scheduler.allowed-failures": 0,
}


def workers(count: int | None, scheduler: str | None) -> AbstractContextManager[Client]:
    """Use the workers of the scheduler at an address, or `count` processes of this machine, by default one per core.

    Raises
    ------
    SettingsError
        If there are fewer than one, or as `remote_workers` and `local_workers`.
    """
    if count is not None and count < 1:
        raise SettingsError(f"--workers {count}: expected at least 1")
    return local_workers(count or os.cpu_count() or 1) if scheduler is None else remote_workers(scheduler)


@contextmanager
def remote_workers(address: str) -> Iterator[Client]:
    """Use the workers of a Dask scheduler, which need this package installed.

    Parameters
    ----------
    address
        Of the scheduler, such as tcp://host:8786.

    Raises
    ------
    SettingsError
        If the package `distributed` is missing, no scheduler answers at the address, or it has no workers.
    """
    _require_dask()
    from distributed import Client

    try:
        client = Client(address, timeout=_SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SettingsError(
            f"scheduler '{address}': no Dask scheduler answers there ({error}); expected an address such as "
            "tcp://host:8786 of one that `dask scheduler` started"
        ) from error
    with client:
        if not client.nthreads():
            raise SettingsError(
                f"scheduler '{address}': it has no workers; start some with `dask worker {address} --nthreads 1`"
            )
        yield client


@contextmanager
def local_workers(count: int) -> Iterator[Client]:
    """Start `count` worker processes, which end with this one, whatever ends that.

    They import the main module of the program, as all processes that Python spawns.

    Raises
    ------
    SettingsError
        If the package `distributed` is missing.
    """
    _require_dask()
    import dask
    from distributed import Client, LocalCluster

    with (
        dask.config.set(_LOCAL),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=0,
            silence_logs=logging.CRITICAL,
            # No dashboard, and any free port for the HTTP server: 8787, the default, may be taken.
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            preload=[__name__],
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def dask_setup(worker: object) -> None:
    """Let a worker, which Dask calls this in, go on at Ctrl-C: the process that started it ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_all(
    client: Client, function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]
) -> Iterator[tuple[TaskT, ResultT | BaseException]]:
    """Start tasks in their order; yield each with its result, or with the error that it ended in, as they come.

    When a worker's process dies, the tasks that it had are run again in the end, one at a time, so that only the one to
    blame fails.
    """
    from distributed import KilledWorker, as_completed

    submitted: dict[Future, TaskT] = {client.submit(function, task, pure=False): task for task in tasks}
    suspects = []
    for future in as_completed(submitted, loop=client.loop):
        error: Any = future.exception()
        if isinstance(error, KilledWorker):
            suspects.append(submitted[future])
        else:
            yield submitted[future], error or future.result()
    for task in suspects:
        future = client.submit(function, task, pure=False)
        error = future.exception()
        if isinstance(error, KilledWorker):
            error = RuntimeError("the worker's process died")
        yield task, error or future.result()


def run_each(
    function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT], count: int | None, scheduler: str | None = None
) -> Iterator[ResultT]:
    """Run tasks on `workers(count, scheduler)`; yield the results as they come, and raise the first error."""
    with workers(count, scheduler) as client:
        for _, result in run_all(client, function, tasks):
            if isinstance(result, BaseException):
                raise result
            yield result


def _require_dask() -> None:
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise SettingsError(
            "the Python package 'distributed' is missing; install it with pip install -c constraints.txt "
            "'.[benchmarks]', here and on the workers"
        ) from error
