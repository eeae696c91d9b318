"""The command line as a whole; what its commands do is tested with them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SAMPLE = Path(__file__).parents[1] / "bags" / "sample"


@pytest.mark.parametrize(
    "command",
    [["bench", "control", "--ticks", "10"], ["replay", str(SAMPLE), "--plan", "40"], ["bag", "info", str(SAMPLE)]],
    ids=["text", "long text", "table"],
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
