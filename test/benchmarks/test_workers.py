"""Tasks on many workers: failing tasks, workers that die, and the end of all workers with their parent."""

import contextlib
import functools
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from distributed import LocalCluster

from benchmarks import workers
from benchmarks.workers import local_workers, remote_workers, run_all, run_each
from contact_reach_ros.errors import SettingsError


def square(value: int) -> int:
    if value == 3:
        raise ValueError("three is refused")
    return value * value


def square_or_die(value: int) -> int:
    if value == 3:
        os._exit(1)
    return value * value


def own_id_for_a_minute(file: str) -> None:
    Path(file).write_text(f"{os.getpid()}\n")
    time.sleep(60)


def ended(pid: int) -> bool:
    """Whether the process is gone within some seconds, or at least a zombie that nobody has collected yet."""
    for _ in range(200):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.1)
    return False


def content(file: Path) -> str:
    for _ in range(600):
        if file.exists() and file.read_text().endswith("\n"):
            return file.read_text()
        time.sleep(0.1)
    raise AssertionError(f"{file} was not written")


def outcome(client, function, count=6):
    return {task: str(found) for task, found in run_all(client, function, range(count))}


def test_every_task_comes_back_with_its_result_or_its_error():
    with local_workers(2) as client:
        assert outcome(client, square) == {0: "0", 1: "1", 2: "4", 3: "three is refused", 4: "16", 5: "25"}


def test_a_bench_ends_with_the_error_of_a_task():
    assert list(run_each(square, [1, 2], count=1)) == [1, 4]
    with pytest.raises(ValueError, match="three is refused"):
        list(run_each(square, [3], count=1))
    with pytest.raises(SettingsError, match="--workers 0: expected at least 1"):
        list(run_each(square, [1], count=0))


@pytest.mark.parametrize("size", [1, 2])
def test_a_process_that_dies_takes_no_other_task_with_it(size, capfd):
    with local_workers(size) as client:
        assert outcome(client, square_or_die) == {
            0: "0",
            1: "1",
            2: "4",
            3: "the worker's process died",
            4: "16",
            5: "25",
        }
    assert capfd.readouterr() == ("", "")


def test_two_crews_at_a_time_and_a_taken_dashboard_port_print_no_warning(capfd):
    with socket.socket() as other:
        # Taken by us or by somebody else: either will do.
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):
            other.bind(("127.0.0.1", 8787))
            other.listen()
        with local_workers(1) as one, local_workers(1) as two:
            assert outcome(one, square, 2) == outcome(two, square, 2) == {0: "0", 1: "1"}
    assert capfd.readouterr() == ("", "")


def test_results_come_as_they_are_ready():
    with local_workers(2) as client:
        tasks = [task for task, _ in run_all(client, time.sleep, [2.0, 0.1, 0.2])]
    assert tasks[0] == 0.1 and sorted(tasks) == [0.1, 0.2, 2.0]


def test_libraries_compute_on_one_thread():
    with local_workers(1) as client:
        assert client.submit(os.getenv, "OPENBLAS_NUM_THREADS").result() == "1"


def test_an_interruption_ends_the_processes_at_once(tmp_path):
    with pytest.raises(KeyboardInterrupt), local_workers(1) as client:
        client.submit(own_id_for_a_minute, str(tmp_path / "id"))
        pid = int(content(tmp_path / "id"))
        raise KeyboardInterrupt
    assert ended(pid)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_processes_end_when_their_parent_is_ended(number, tmp_path, capfd):
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_workers as t\n"
        "if __name__ == '__main__':\n"
        "    with t.local_workers(1) as client: list(t.run_all(client, t.own_id_for_a_minute, [sys.argv[2]]))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(program)
    command = [sys.executable, str(script), str(Path(__file__).parent), str(tmp_path / "id")]
    # A shell's background jobs ignore SIGINT, and so would the programs that they start.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    parent = subprocess.Popen(command, start_new_session=True, preexec_fn=heed)
    try:
        pid = int(content(tmp_path / "id"))
    finally:
        # As Ctrl-C does it: to all processes of the terminal's foreground.
        os.killpg(parent.pid, number)
        parent.wait()
    assert ended(pid)
    errors = capfd.readouterr().err
    # Python's own for an interruption that nobody catches, in the parent alone.
    assert errors.count("Traceback") == errors.count("KeyboardInterrupt") == (number == signal.SIGINT)


class TestDask:
    @pytest.fixture
    def cluster(self):
        with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster:
            yield cluster

    def test_its_workers_do_the_same(self, cluster):
        with remote_workers(cluster.scheduler_address) as client:
            assert outcome(client, square) == {0: "0", 1: "1", 2: "4", 3: "three is refused", 4: "16", 5: "25"}

    def test_a_scheduler_without_workers_is_refused(self, cluster):
        cluster.scale(0)
        for _ in range(100):
            if not cluster.scheduler.workers:
                break
            time.sleep(0.1)
        with (
            pytest.raises(SettingsError, match="has no workers; start some with `dask worker"),
            remote_workers(cluster.scheduler_address),
        ):
            pass

    def test_nobody_at_the_address(self, monkeypatch):
        monkeypatch.setattr(workers, "_SCHEDULER_TIMEOUT", "1s")
        with (
            pytest.raises(SettingsError, match=r"'tcp://127\.0\.0\.1:1': no Dask scheduler answers"),
            remote_workers("tcp://127.0.0.1:1"),
        ):
            pass

    def test_a_missing_package_is_named(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "distributed", None)
        with (
            pytest.raises(SettingsError, match=r"'distributed' is missing; install it with pip install"),
            remote_workers("tcp://127.0.0.1:8786"),
        ):
            pass
