"""Tasks on several processes: their results and errors, and the end of all processes with their parent."""

import functools
import os
import signal
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


def ended(pid: int) -> bool:
    """Whether the process is gone within some seconds, or at least a zombie that nobody has collected yet."""
    for _ in range(200):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.1)
    return False


def content(file: Path) -> str:
    for _ in range(600):
        if file.exists() and file.read_text().endswith("\n"):
            return file.read_text()
        time.sleep(0.1)
    raise AssertionError(f"{file} was not written")


def test_every_task_comes_back_with_its_result_or_ends_the_run_with_its_error(capfd):
    assert sorted(run_each(square, [1, 2, 4], 2)) == [1, 4, 16]
    with pytest.raises(ValueError, match="three is refused"):
        list(run_each(square, [3], 1))
    with pytest.raises(ContactReachError, match="a worker's process died"):
        list(run_each(die, [1], 1))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_processes_end_when_their_parent_is_ended(number, tmp_path, capfd):
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_workers as t\n"
        "if __name__ == '__main__': list(t.run_each(t.own_id_for_a_minute, [sys.argv[2]], 1))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(program)
    command = [sys.executable, str(script), str(Path(__file__).parent), str(tmp_path / "id")]
    # A shell's background jobs ignore SIGINT, and so would the programs that they start.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    parent = subprocess.Popen(command, start_new_session=True, preexec_fn=heed, env=environment)
    try:
        pid = int(content(tmp_path / "id"))
    finally:
        # As Ctrl-C does it: to all processes of the terminal's foreground; others to the parent alone.
        (os.killpg if number == signal.SIGINT else os.kill)(parent.pid, number)
        parent.wait()
    assert ended(pid)
    errors = capfd.readouterr().err
    # Python's own for an interruption that nobody catches, in the parent alone.
    assert errors.count("KeyboardInterrupt") == (number == signal.SIGINT)
