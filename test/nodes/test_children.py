"""Processes that are started beside the stack."""

import os
import time
from pathlib import Path

import pytest

from contact_reach_ros.bringup.children import Children

WRITES_ITS_ID = "import os, pathlib, time; pathlib.Path({0!r}).write_text(str(os.getpid())); time.sleep({1})"


def id_in(file: Path) -> int:
    deadline = time.monotonic() + 20.0
    while not (file.exists() and file.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return int(file.read_text())


def test_work_aside_may_end_by_itself_and_does_not_outlive_the_stack(tmp_path):
    children = Children(tmp_path / "log")
    short, long = tmp_path / "short", tmp_path / "long"
    children.start_aside(["-c", WRITES_ITS_ID.format(str(short), 0.0)])
    children.start_aside(["-c", WRITES_ITS_ID.format(str(long), 600.0)])
    ids = [id_in(short), id_in(long)]
    os.waitid(os.P_PID, ids[0], os.WEXITED | os.WNOWAIT)
    children.check()
    assert children.process_ids == {}
    os.kill(ids[1], 0)
    children.close()
    for process_id in ids:
        with pytest.raises(ProcessLookupError):
            os.kill(process_id, 0)
