"""Tasks on several processes: their results and errors, and the end of all processes with their parent."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.workers import run_each
from contact_reach_ros.errors import ContactReachError


def square(value: int) -> int:
    if value == 3:
        raise ValueError("three is refused")
    return value * value


def die(value: int) -> None:
    os._exit(value)


def own_id_for_a_minute(file: str) -> None:
    Path(file).write_text(f"{os.getpid()}\n")
    time.sleep(60)


def once(condition):
    """What a condition is once it holds."""
    for _ in range(600):
        if found := condition():
            return found
        time.sleep(0.1)
    raise AssertionError("not within a minute")


def test_every_task_comes_back_with_its_result_or_ends_the_run_with_its_error(capfd):
    assert sorted(run_each(square, [1, 2, 4], 2)) == [1, 4, 16]
    with pytest.raises(ValueError, match="three is refused"):
        list(run_each(square, [3], 1))
    with pytest.raises(ContactReachError, match="a worker's process died"):
        list(run_each(die, [1], 1))
    assert capfd.readouterr() == ("", "")


def test_processes_end_when_their_parent_is_killed(tmp_path):
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_workers as t\n"
        "if __name__ == '__main__': list(t.run_each(t.own_id_for_a_minute, [sys.argv[2]], 1))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(program)
    command = [sys.executable, str(script), str(Path(__file__).parent), str(tmp_path / "id")]
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    with subprocess.Popen(command, env=environment) as parent:
        try:
            pid = int(once(lambda: (tmp_path / "id").exists() and (tmp_path / "id").read_text().rstrip()))
        finally:
            parent.kill()
    once(lambda: not Path(f"/proc/{pid}").exists() or " Z " in Path(f"/proc/{pid}/stat").read_text())
