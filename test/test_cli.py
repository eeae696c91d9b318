"""The command line as a whole; what its commands do is tested with them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from contact_reach_command import contact_reach

from contact_reach_ros.cli import main

SAMPLE = Path(__file__).parents[1] / "bags" / "sample"


@pytest.mark.parametrize(
    "command",
    [["reexecute", str(SAMPLE)], ["bag", "info", str(SAMPLE)]],
    ids=["long text", "table"],
)
def test_it_ends_without_a_word_where_nobody_reads_its_output(command: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.Popen(
        [sys.executable, "-m", "contact_reach_ros.cli", *command], stdout=writing, stderr=subprocess.PIPE, text=True
    )
    os.close(writing)
    _, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (1, "")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], {"bag": ""}),
        (["bags/sample", "--port", "0"], {"bag": "bags/sample", "port": 0}),
    ],
)
def test_view_passes_on_what_is_given_and_no_bag_for_the_running_stack(monkeypatch, arguments, expected):
    given = []
    monkeypatch.setattr("contact_reach_ros.nodes.viewer.view", lambda chosen, *_: given.append(chosen) or 0)
    assert contact_reach("view", *arguments) == 0 and given == [expected]


def test_tool_says_how_a_stack_gets_another_tool(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["tool", "my_tool.yaml"])
    assert ended.value.code == 2
    assert "put the section 'tool' under '/**: ros__parameters:'" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["table1", "--targets", "2"], ["page", "--out", "page"], ["planner", "--quick"]])
def test_benchmarks_of_the_repository_are_named_with_the_command_that_runs_them(capsys, arguments):
    assert contact_reach("bench", *arguments) == 2
    assert f"make bench NAME={arguments[0]}" in capsys.readouterr().err
