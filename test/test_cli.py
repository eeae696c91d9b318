"""The command line as a whole; what its commands do is tested with them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from contact_reach_command import contact_reach

from contact_reach_ros.cli import main
from contact_reach_ros.errors import InputError
from contact_reach_ros.resources import write_text

SAMPLE = Path(__file__).parents[1] / "bags" / "sample"


def test_it_ends_without_a_word_where_nobody_reads_its_output() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.Popen(
        [sys.executable, "-m", "contact_reach_ros.cli", "bag", "info", str(SAMPLE)],
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(writing)
    _, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (1, "")


def test_it_says_in_one_line_that_there_is_no_room_for_its_output() -> None:
    command = [sys.executable, "-m", "contact_reach_ros.cli", "bag", "info", str(SAMPLE)]
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=300)
    assert result.returncode == 1
    assert result.stderr == "contact-reach: the output cannot be written: No space left on device\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["report", ""], "argument BAG: expected a path, not an empty text"),
        (["up", "--namespace", "1a"], "argument --namespace: '1a': expected a name of letters, digits and _"),
        (["goto", "1", "2", "3", "--namespace", "ä" * 40], "expected a name of letters, digits and _"),
    ],
)
def test_what_is_no_path_or_namespace_is_refused(arguments, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", [b"b\xc3\xa4r", b"b\xe4r"])
def test_a_report_needs_no_home_and_no_text_beyond_ascii(name: bytes, tmp_path: Path) -> None:
    """The folder's name is an umlaut in UTF-8 and in Latin-1."""
    folder = tmp_path / os.fsdecode(name)
    shutil.copytree(SAMPLE, folder / "sample")
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
    env = {key: value for key, value in os.environ.items() if key not in ("HOME", "XDG_CACHE_HOME", "DISPLAY")}
    result = subprocess.run(
        [sys.executable, "-m", "contact_reach_ros.cli", "report", folder / "sample", "--json", folder / "r.json"],
        env=env | ascii_only,
        capture_output=True,
    )
    assert (result.returncode, result.stderr) == (0, b""), result
    assert (folder / "sample.html").stat().st_size > 1_000_000 and (folder / "r.json").is_file()


def test_a_file_for_which_there_is_no_room_leaves_the_one_before(tmp_path, monkeypatch):
    file = tmp_path / "report.json"
    write_text(file, "before")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=3))
    with pytest.raises(InputError, match=r"report\.json' cannot be written: No space left on device"):
        write_text(file, "longer than before")
    assert file.read_text() == "before"
    write_text(file, "shorter")
    assert file.read_text() == "shorter"


def test_a_file_may_be_a_pipe_or_a_link(tmp_path):
    reading, writing = os.pipe()
    write_text(Path(f"/dev/fd/{writing}"), "words")
    assert os.read(reading, 10) == b"words"
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_text(tmp_path / "link", "words")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_text() == "words"


@pytest.mark.parametrize("arguments", [["goto", "0.5", "0.1", "0.3"], ["demo", "--scene", "free"]])
def test_without_a_folder_for_the_logs_of_ros_it_says_which_variable_to_set(arguments, tmp_path):
    env = {key: value for key, value in os.environ.items() if key not in ("ROS_LOG_DIR", "ROS_HOME")}
    command = [sys.executable, "-m", "contact_reach_ros.cli", *arguments]
    env |= {"HOME": "/proc/nohome", "XDG_CACHE_HOME": str(tmp_path)}
    result = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert result.returncode == 2 and "set ROS_LOG_DIR to a folder" in result.stderr, result
    assert "Traceback" not in result.stderr


def test_view_passes_on_what_is_given_and_no_bag_for_the_running_stack(monkeypatch):
    given = []
    monkeypatch.setattr("contact_reach_ros.nodes.viewer.view", lambda chosen, *_: given.append(chosen) or 0)
    assert contact_reach("view") == contact_reach("view", "bags/sample", "--port", "0") == 0
    assert given == [{"bag": ""}, {"bag": "bags/sample", "port": 0}]
