"""Results on disk that an interruption leaves whole."""

import pytest

from benchmarks.output import read_report, write_report, write_whole
from contact_reach_ros.errors import SettingsError


def test_a_report_is_read_back(tmp_path):
    write_report({"bench": "table1", "a": 0.1}, tmp_path / "report.json")
    assert read_report(tmp_path / "report.json", "table1") == {"bench": "table1", "a": 0.1}


@pytest.mark.parametrize(
    ("text", "message"), [("", "not JSON"), ('{"bench": "tab', "not JSON"), ("[]", "not a result of bench table1")]
)
def test_a_file_of_something_else_is_refused(tmp_path, text, message):
    (tmp_path / "f").write_text(text)
    with pytest.raises(SettingsError, match=message):
        read_report(tmp_path / "f", "table1")


def test_a_file_is_replaced_as_a_whole(tmp_path):
    write_whole(tmp_path / "new" / "f", "one")
    write_whole(tmp_path / "new" / "f", "two")
    assert [(file.name, file.read_text()) for file in (tmp_path / "new").iterdir()] == [("f", "two")]
