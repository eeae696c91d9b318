"""The command: what it writes, how it goes on after an interruption, and what it refuses."""

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from bench_command import bench
from test_grid import TINY, figures
from test_workers import ended

from benchmarks import table1
from benchmarks.grid_run import Running, partial_of
from benchmarks.output import read_report
from benchmarks.table1 import Table1, bench_table1
from contact_reach_ros.errors import SettingsError

pytestmark = pytest.mark.slow

BENCH = Table1(
    scenes=("free",),
    goals=("hold",),
    methods=("cma_es",),
    targets=2,
    repeats=3,
    timeout=0.6,
    latency=0.05,
)


def refuse(arguments, message, capsys):
    assert bench(table1, *arguments) == 2
    assert message in capsys.readouterr().err


def whole(report):
    """What has to be the same in two runs."""
    return {**report, "episodes": [figures(entry) for entry in report["episodes"]], "machine": None}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Report and file of a run that nothing interrupted, on two processes."""
    file = tmp_path_factory.mktemp("finished") / "table.json"
    return bench_table1(BENCH, Running(file, workers=2), TINY), file


def test_files_hold_what_is_returned(finished):
    report, file = finished
    assert json.loads(file.read_text()) == report
    assert [(entry["target"], entry["repeat"]) for entry in report["episodes"]] == [
        (target, repeat) for target in range(2) for repeat in range(3)
    ]
    assert not partial_of(file).exists()
    assert {"claim", "required", "value", "ci95", "met"} <= set(report["claims"][0])
    assert report["claims"][0]["claim"] == "free: settles at the goal"
    assert not report["claims"][0]["met"]


def test_a_run_that_was_terminated_goes_on_where_it_was(finished, tmp_path):
    file = tmp_path / "table.json"
    program = tmp_path / "run.py"
    program.write_text(
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "if __name__ == '__main__':\n"
        "    from test_bench_table1 import BENCH, TINY, Running, bench_table1\n"
        "    bench_table1(BENCH, Running(Path(sys.argv[2]), workers=1), TINY)\n"
    )
    run = subprocess.Popen([sys.executable, str(program), str(Path(__file__).parent), str(file)])
    try:
        while len(episodes(file)) < 2:
            assert run.poll() is None
            time.sleep(0.02)
        children = [child.pid for child in psutil.Process(run.pid).children(recursive=True)]
        run.send_signal(signal.SIGTERM)
        assert run.wait(30) == -signal.SIGTERM
    finally:
        run.kill()
    # At least the worker.
    assert children
    assert all(ended(child) for child in children)
    kept = episodes(file)
    assert 2 <= len(kept) < 6

    resumed = bench_table1(BENCH, Running(file, workers=1), TINY)
    report = whole(finished[0])
    assert whole(resumed) == report
    assert [entry for entry in resumed["episodes"] if entry in kept] == kept
    assert not partial_of(file).exists()


def episodes(file):
    partial = partial_of(file)
    return read_report(partial, "table1")["episodes"] if partial.exists() else []


def test_other_settings_cannot_go_on(finished):
    _, file = finished
    before = file.read_text()
    for change, setup, message in (
        ({}, dataclasses.replace(TINY, timeout=0.7), r"timeout was 0\.6 and is 0\.7 now"),
        ({"targets": 1}, TINY, "holds 3 episodes that these options leave out"),
        ({"targets": 3, "latency": 0.06}, TINY, r"latency was 0\.05 and is 0\.06 now"),
    ):
        with pytest.raises(SettingsError, match=message):
            bench_table1(dataclasses.replace(BENCH, **change), Running(file), setup)
    assert file.read_text() == before


def test_a_finished_run_is_reported_again_without_running_anything(finished, monkeypatch, capsys):
    report, file = finished
    monkeypatch.setattr("benchmarks.grid_run.run_each", None)
    assert bench_table1(BENCH, Running(file), TINY) == report
    assert "| free | cma_es | 0/6 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "rrt"], "--methods 'rrt' is unknown; expected one of contact_reach"),
        (["--goals", "held"], "--goals 'held' is unknown; expected one of hold, free"),
        (["--scenes", "sphere"], "scene 'sphere' is unknown"),
        (["--targets", "0"], "--targets 0: expected at least 1"),
        (["--workers", "0"], "--workers 0: expected at least 1"),
        (["--timeout", "nan"], "--timeout nan: expected a positive time"),
        (["--preset", "paper"], "preset 'paper' is unknown; expected one of paper_linear"),
        (["--latency", "5"], "--latency 5: expected 0.001 to 1 s"),
    ],
)
def test_what_cannot_be_run_is_refused(arguments, message, capsys):
    refuse(arguments, message, capsys)
