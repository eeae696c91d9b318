"""Which CPUs a process runs on, and which of its threads comes first."""

import os
import threading

import pytest

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.ros.scheduling import Role, choose_cpus, give_way


def test_on_few_cpus_the_loop_has_one_for_itself():
    for permitted in ({0, 1}, {2, 5}, {0, 1, 2}):
        loop = choose_cpus("auto", Role.CONTROLLER, permitted)
        assert len(loop) == 1
        for role in (Role.PLANNER, Role.OBSERVER, Role.RECORDER):
            assert choose_cpus("auto", role, permitted) == permitted - loop
        assert choose_cpus("auto", Role.VIEWER, permitted) == permitted


def test_on_one_or_many_cpus_and_where_the_user_wants_it_the_system_chooses():
    for role in Role:
        assert all(choose_cpus("auto", role, permitted) == permitted for permitted in ({3}, set(range(4))))
        assert choose_cpus("all", role, {0, 1}) == {0, 1}
    # Numbers also of isolated CPUs.
    assert choose_cpus("0, 1", Role.CONTROLLER, {0}) == {0, 1}
    for wanted in ("", "10000", "some", "-1"):
        with pytest.raises(SettingsError, match="parameter cpus"):
            choose_cpus(wanted, Role.CONTROLLER, {0, 1})


@pytest.mark.parametrize(("priority", "left"), [(Role.DRIVER.value, 50), (Role.OBSERVER.value, 50), (20, 19)])
def test_what_gives_way_comes_behind_every_loop(priority, left):
    found = []

    def work():
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except PermissionError:
            return
        give_way()
        found.append((os.sched_getscheduler(0), os.sched_getparam(0).sched_priority))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    if not found:
        pytest.skip("no real-time priority permitted")
    assert found == [(os.SCHED_FIFO, left)]
    assert left < min(Role.DRIVER.value, Role.CONTROLLER.value, Role.OBSERVER.value)
