"""Results on disk that an interruption leaves whole."""

import pytest

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments.journal import Journal, journal_of, read_journal, write_whole


def test_what_was_appended_is_read_back(tmp_path):
    journal = Journal(journal_of(tmp_path / "table.json"))
    journal.start({"run": 1}, [{"a": 0.1}])
    journal.append({"a": None})
    assert journal.file == tmp_path / "table.json.partial"
    assert read_journal(journal.file) == ({"run": 1}, [{"a": 0.1}, {"a": None}])


def test_a_line_that_was_cut_off_is_left_out_and_written_again(tmp_path):
    journal = Journal(tmp_path / "j")
    journal.start({"run": 1}, [])
    journal.append({"a": 1})
    journal.append({"a": 2})
    text = journal.file.read_text()
    journal.file.write_text(text[:-4])
    header, records = read_journal(journal.file)
    assert records == [{"a": 1}]
    journal.start(header, records)
    journal.append({"a": 2})
    assert journal.file.read_text() == text


@pytest.mark.parametrize(("text", "message"), [("", "is empty"), ("no json\n", "not JSON lines")])
def test_a_file_of_something_else_is_refused(tmp_path, text, message):
    (tmp_path / "j").write_text(text)
    with pytest.raises(SettingsError, match=message):
        read_journal(tmp_path / "j")


def test_a_number_that_json_does_not_have_is_refused_before_it_is_written(tmp_path):
    journal = Journal(tmp_path / "j")
    journal.start({}, [])
    with pytest.raises(ValueError, match="not JSON compliant"):
        journal.append({"a": float("nan")})
    assert read_journal(journal.file) == ({}, [])


def test_a_file_is_replaced_as_a_whole(tmp_path):
    write_whole(tmp_path / "new" / "f", "one")
    write_whole(tmp_path / "new" / "f", "two")
    assert [(file.name, file.read_text()) for file in (tmp_path / "new").iterdir()] == [("f", "two")]
