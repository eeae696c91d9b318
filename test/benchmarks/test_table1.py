"""The command: what it runs and writes, and what it refuses."""

import json

import pytest
from contact_reach_command import bench
from test_grid import TINY

from benchmarks import pictures
from benchmarks.table1 import Table1, bench_table1

METHODS = ("contact_reach",)
BENCH = Table1(scenes=("free",), goals=("hold",), methods=METHODS, targets=2, repeats=3, timeout=0.6, latency=0.05)


@pytest.mark.slow
def test_a_run_writes_its_episodes_and_claims_and_can_be_drawn(tmp_path, capsys):
    file, picture = tmp_path / "table.json", tmp_path / "table.png"
    report = bench_table1(BENCH, file, workers=2, setup=TINY)
    assert json.loads(file.read_text()) == report
    assert [(entry["target"], entry["repeat"]) for entry in report["episodes"]] == [
        (target, repeat) for target in range(2) for repeat in range(3)
    ]
    assert report["claims"][0]["claim"] == "free: settles at the goal within ε"
    assert not report["claims"][0]["met"]
    assert "| 0/6 |" in capsys.readouterr().out
    assert bench(pictures, file, file, picture) == 0
    assert picture.stat().st_size > 10_000
