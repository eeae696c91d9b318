"""Results on disk that an interruption leaves whole."""

import pytest

from benchmarks.output import command_of, read_report, write_report
from benchmarks.setting import Sweep
from benchmarks.table1 import Table1
from contact_reach_ros.errors import SettingsError


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "not JSON"), ('{"bench": "tab', "not JSON"), ("[]", "not the result of benchmark table1")],
)
def test_a_file_of_something_else_is_refused(tmp_path, text, message):
    (tmp_path / "f").write_text(text)
    with pytest.raises(SettingsError, match=message):
        read_report(tmp_path / "f", "table1")


def test_a_file_is_replaced_as_a_whole(tmp_path):
    write_report({"bench": "one"}, tmp_path / "new" / "f")
    write_report({"bench": "two"}, tmp_path / "new" / "f")
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["f"]
    assert read_report(tmp_path / "new" / "f", "two") == {"bench": "two"}


def test_a_command_has_what_differs_from_the_defaults_and_no_path_of_this_machine():
    bench = Table1("paper_hinge", scenes=("free", "/tmp/own.yaml"), goals=("hold",), targets=2)
    assert command_of("table1", bench) == (
        "python -m benchmarks.table1 --preset paper_hinge --scenes free own.yaml --goals hold --targets 2"
    )
    assert command_of("table1", Table1()) == "python -m benchmarks.table1"
    sweep = Sweep("latency", (0.04, 0.1), others=("max_steps=2",))
    assert command_of("setting", sweep) == "python -m benchmarks.setting latency 0.04 0.1 --others max_steps=2"
