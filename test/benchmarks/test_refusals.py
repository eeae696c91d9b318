"""What a benchmark cannot run it refuses in one line, before it begins."""

import pytest
from contact_reach_command import bench

from benchmarks import clutter, foam, observer, setting, solver, table1


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        (table1, "--methods rrt", "--methods 'rrt' is unknown; expected one of contact_reach"),
        (table1, "--scenes sphere", "scene 'sphere' is unknown"),
        (table1, "--targets 0", "--targets 0: expected at least 1"),
        (table1, "--preset paper", "preset 'paper' is unknown; expected one of paper_linear"),
        (clutter, "--scenes 0", "--scenes 0: expected at least 1"),
        (clutter, "--only 3 -1", "--only -1: expected at least 0"),
        (clutter, "--kind contact --only 3", "expected one of them"),
        (solver, "--states 1", "at least 2"),
        (setting, "contact_wieght 1", "contact_wieght"),
        (setting, "null_stiffness 1000", "null_stiffness"),
        (setting, "max_steps 1 --others population", "expected NAME=VALUE"),
        (foam, "--force 101", "force = 101 N: expected a number above 0, at most 100"),
        (observer, "--minutes 0", "minutes = 0: expected a number above 0"),
    ],
)
def test_what_cannot_be_run_is_refused(module, arguments, message, capsys):
    assert bench(module, *arguments.split()) == 2
    assert message in capsys.readouterr().err
