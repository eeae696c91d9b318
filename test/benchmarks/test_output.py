"""Results on disk that an interruption leaves whole."""

import pytest

from benchmarks.output import read_report, write_report
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
