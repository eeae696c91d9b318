"""How processes of nodes run and end: priority, and signals, which end nothing before it is asked for."""

import os
import signal
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from stack_helpers import environment, running, wait_for

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.bringup.stack_processes import StackProcesses


@pytest.mark.usefixtures("signal_handlers")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_raised_where_it_is_asked_for_and_ignored_while_all_is_ended(number):
    # Not as with nohup.
    signal.signal(number, signal.SIG_DFL)
    stack = StackProcesses(Mock(), BringupOptions())
    stack.check()
    os.kill(os.getpid(), number)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            stack.check()


def executable(name):
    """Command of an executable; as in a shell's job, Ctrl-C is not ignored."""
    return [sys.executable, "-c", f"from contact_reach_ros import executables; executables.{name}()"]


def is_handled(process, number):
    """Whether Python has a handler for a signal in a process."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


@pytest.mark.parametrize(("number", "seconds"), [(signal.SIGINT, 0.0), (signal.SIGTERM, 1.0)])
def test_a_node_that_is_still_starting_ends_well(number, seconds, tmp_path):
    output = tmp_path / "output.txt"
    with running(executable("planner"), environment(), output) as process:
        wait_for(lambda: "rclpy" in Path(f"/proc/{process.pid}/maps").read_text(), 60, "the node is being imported")
        assert not is_handled(process, signal.SIGINT)
        time.sleep(seconds)
        process.send_signal(number)
        assert process.wait(30) == -number
        # A quick one has begun to compile by then.
        assert all("planner: preparing the programs" in line for line in output.read_text().splitlines())


def test_a_recorder_that_is_interrupted_at_once_completes_its_bag(tmp_path):
    printed = tmp_path / "printed.txt"
    for attempt, seconds in enumerate((0.0, 0.05, 0.1)):
        bag = tmp_path / str(attempt)
        command = [*executable("recorder"), "--ros-args", "-p", f"bag:={bag}"]
        with running(command, environment(), printed) as process:
            wait_for(lambda: "recording to" in printed.read_text(), 30, "a bag is begun")
            time.sleep(seconds)
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
        assert not BagReader(bag).notes


def test_a_loop_has_the_priority_that_the_system_permits_and_a_second_ctrl_c_changes_nothing(tmp_path):
    def policies() -> set[int]:
        return {os.sched_getscheduler(int(thread)) for thread in os.listdir(f"/proc/{process.pid}/task")}

    output = tmp_path / "output.txt"
    with running(executable("observer"), environment(), output) as process:
        wait_for(lambda: "active" in output.read_text(), 60, "observer up")
        wait_for(lambda: os.SCHED_FIFO in policies() or "no real-time priority" in output.read_text(), 10, "priority")
        for _ in range(40):
            process.send_signal(signal.SIGINT)
            time.sleep(0.02)
            if process.poll() is not None:
                break
        assert process.wait(30) == 0
