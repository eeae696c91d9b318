"""Which CPUs a process runs on, and which of its threads comes first."""

import os
import subprocess
import sys
import threading

import pytest
from stack_helpers import environment, module, running, wait_for

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.ros.scheduling import (
    CONTROLLER_PRIORITY,
    DRIVER_PRIORITY,
    OBSERVER_PRIORITY,
    Role,
    choose_cpus,
    give_way,
    isolated_cpus,
)

_ARRANGE_THREADS_THAT_END = """
import itertools, os, threading
from contact_reach_ros.ros.scheduling import Role, take_priority, use_cpus

def churn():
    while not ended.is_set():
        threads = [threading.Thread(target=int) for _ in range(20)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

ended = threading.Event()
churning = threading.Thread(target=churn)
churning.start()
try:
    for role in itertools.islice(itertools.cycle((Role.COMPUTING, Role.BACKGROUND)), 1000):
        use_cpus(os.sched_getaffinity(0))
        take_priority(role, 20)
finally:
    ended.set()
    churning.join()
"""


def test_on_few_cpus_the_loop_has_one_for_itself():
    for permitted in ({0, 1}, {2, 5}, {0, 1, 2}):
        loop = choose_cpus("auto", Role.LOOP, permitted)
        assert len(loop) == 1
        for role in (Role.COMPUTING, Role.MONITOR, Role.BACKGROUND):
            assert choose_cpus("auto", role, permitted) == permitted - loop
        assert choose_cpus("auto", Role.ONLOOKER, permitted) == permitted


@pytest.mark.parametrize("role", Role)
@pytest.mark.parametrize("permitted", [{0}, {3}, set(range(4)), set(range(64))])
def test_on_one_or_many_cpus_the_system_chooses(role, permitted):
    assert choose_cpus("auto", role, permitted) == permitted


@pytest.mark.parametrize("role", Role)
def test_a_choice_of_the_user_is_kept(role):
    assert choose_cpus("all", role, {0, 1}) == {0, 1}
    assert choose_cpus("1", role, {0, 1}) == {1}
    assert choose_cpus("0, 2", role, {0, 1, 2, 3}) == {0, 2}


@pytest.mark.parametrize("wanted", ["", "2", "0,2", "some", "0-1", "-1"])
def test_cpus_that_there_are_not_are_refused(wanted):
    with pytest.raises(SettingsError, match=r"parameter cpus: '.*'; expected auto, all, or numbers out of \[0, 1\]"):
        choose_cpus(wanted, Role.LOOP, {0, 1})


def test_isolated_cpus_are_the_loops(tmp_path):
    file = tmp_path / "isolated"
    for text, isolated in (("\n", set()), ("3\n", {3}), ("1,4-6\n", {1, 4, 5, 6})):
        file.write_text(text)
        assert isolated_cpus(file) == isolated
    assert isolated_cpus(tmp_path / "none") == set()
    assert choose_cpus("auto", Role.LOOP, {0}, {1}) == {1}
    assert choose_cpus("auto", Role.LOOP, {0, 1, 2, 3}, {4, 5}) == {5}
    for role in set(Role) - {Role.LOOP}:
        assert choose_cpus("auto", role, {0}, {1}) == {0}
    assert choose_cpus("1", Role.MONITOR, {0}, {1}) == {1}
    with pytest.raises(SettingsError, match=r"numbers out of \[0, 1\]"):
        choose_cpus("2", Role.LOOP, {0}, {1})


def in_a_thread(work) -> tuple[int, int]:
    """Scheduling policy and priority of a thread after some work."""
    found = []

    def run():
        work()
        found.append((os.sched_getscheduler(0), os.sched_getparam(0).sched_priority))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return found[0]


def test_without_real_time_priority_there_is_nothing_to_give_way_with():
    assert in_a_thread(give_way) == (os.SCHED_OTHER, 0)


@pytest.mark.parametrize(("priority", "left"), [(DRIVER_PRIORITY, 50), (OBSERVER_PRIORITY, 50), (20, 19)])
def test_who_gives_way_comes_behind_every_loop(priority, left):
    def work():
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        give_way()

    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        pytest.skip("no real-time priority permitted")
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    assert in_a_thread(work) == (os.SCHED_FIFO, left)
    assert left < min(DRIVER_PRIORITY, CONTROLLER_PRIORITY, OBSERVER_PRIORITY)


def test_threads_that_end_meanwhile_are_left_out():
    """As those that compile do, just before a planner is arranged."""
    result = subprocess.run([sys.executable, "-c", _ARRANGE_THREADS_THAT_END], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_in_real_time_a_loop_has_the_priority_that_the_system_permits(tmp_path):
    def policies() -> set[int]:
        return {os.sched_getscheduler(int(thread)) for thread in os.listdir(f"/proc/{process.pid}/task")}

    output = tmp_path / "observer.txt"
    with running(module("nodes.observer"), environment(), output) as process:
        wait_for(lambda: "active" in output.read_text() or process.poll() is not None, 60, "the observer is active")
        wait_for(lambda: os.SCHED_FIFO in policies() or "no real-time priority" in output.read_text(), 10, "priority")
