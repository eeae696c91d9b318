"""The plans of closed-loop runs, rolled out by other models than the one that they were made with."""

import json

import pytest

from contact_reach_ros.cli import main
from contact_reach_ros.experiments.bench_referee import MUJOCO, OURS, bench_referee
from contact_reach_ros.planning.settings import PlanningSettings

FEW = PlanningSettings(population=32, elite=8, line_search_points=32, max_steps=4, substeps=4)


@pytest.mark.slow
def test_brax_and_mujoco_agree_with_the_plans(tmp_path, capsys):
    file = tmp_path / "report.json"
    bench_referee(["generalized"], ("ball",), plans=4, file=file, settings=FEW)
    report = json.loads(file.read_text())["scenes"]["ball"]
    rows = {(row["model"], row["against"]): row for row in report["rows"]}
    assert set(rows) == {(OURS, MUJOCO), ("generalized", MUJOCO), (OURS, "generalized")}
    assert report["largest_force_n"]["max"] > 1.0
    assert all(0.0 < row["tip_mm"]["max"] < 2.0 for row in rows.values())
    assert rows[OURS, MUJOCO]["force_n"]["p50"] < 0.3
    # Another model would be noticed.
    assert rows["generalized", MUJOCO]["tip_mm"]["p50"] != rows[OURS, MUJOCO]["tip_mm"]["p50"]
    assert "| ball (" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments", [["--plans", "3"], ["--against", "generalized", "--states", "3"], ["--against", "mujoco"]]
)
def test_options_that_do_not_go_together_are_refused(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(["bench", "model", *arguments])
    assert end.value.code == 2
    assert "--against" in capsys.readouterr().err
