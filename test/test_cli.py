"""The command line as a whole; what its commands do is tested with them."""

import os
import subprocess
import sys
from pathlib import Path

from contact_reach_command import contact_reach

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


def test_view_passes_on_what_is_given_and_no_bag_for_the_running_stack(monkeypatch):
    given = []
    monkeypatch.setattr("contact_reach_ros.nodes.viewer.view", lambda chosen, *_: given.append(chosen) or 0)
    assert contact_reach("view") == contact_reach("view", "bags/sample", "--port", "0") == 0
    assert given == [{"bag": ""}, {"bag": "bags/sample", "port": 0}]
