"""The state machine: what its table allows, and what stops the arm."""

import re
from pathlib import Path

import numpy as np
import pytest
from arm_simulation import HOME, REST

from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.control.supervisor import TRANSITIONS, Event, Mode, Supervisor
from contact_reach_ros.errors import InputError
from contact_reach_ros.robot import iiwa14

SETTINGS = SupervisionSettings()
LIMITS = np.array(iiwa14.VELOCITY_LIMITS)


@pytest.fixture
def supervisor() -> Supervisor:
    made = Supervisor(SETTINGS)
    made.happens(Event.START)
    return made


def test_the_picture_in_the_docs_is_the_table():
    page = (Path(__file__).parents[2] / "docs" / "safety.md").read_text()
    drawn = set(re.findall(r"^    (\w+) --> (\w+): (.+)$", page, re.MULTILINE))
    # What leaves a state as it is needs no arrow.
    table = {(start.name, end.name, event.value) for (start, event), end in TRANSITIONS.items() if start is not end}
    assert drawn == table


def test_every_state_can_be_stopped_and_only_reset_leads_out():
    stops = {Mode.STOPPED, Mode.SILENT}
    assert all(TRANSITIONS[mode, Event.STOP] is Mode.STOPPED for mode in set(Mode) - stops)
    outs = {(start, event) for (start, event), end in TRANSITIONS.items() if start in stops and end not in stops}
    assert outs == {(Mode.STOPPED, Event.RESET), (Mode.SILENT, Event.RESET)}
    assert TRANSITIONS[Mode.STOPPED, Event.NO_REST] is Mode.SILENT


def test_events_that_do_not_belong_to_a_state_change_nothing():
    supervisor = Supervisor(SETTINGS)
    for event in (Event.PLAN, Event.PLAN_ENDED, Event.RESET):
        assert not supervisor.happens(event)
        assert supervisor.mode is Mode.WAITING
    supervisor.stop("first")
    for event in (Event.START, Event.PLAN, Event.PLAN_ENDED):
        assert not supervisor.happens(event)
    supervisor.stop("second")
    assert (supervisor.mode, supervisor.stop_reason) == (Mode.STOPPED, "first")
    assert supervisor.happens(Event.RESET)
    assert (supervisor.mode, supervisor.stop_reason) == (Mode.HOLDING, "")


class TestStopThatBringsNoRest:
    """Nothing is commanded any more, and the reason tells both stories."""

    MS = 1_000_000
    SLOW = np.eye(7)[4] * 2.0 * SETTINGS.reset_velocity

    @pytest.fixture
    def stopped(self, supervisor) -> Supervisor:
        supervisor.stop("pushed")
        return supervisor

    def watch(self, supervisor, v, first_ms, last_ms):
        for ms in range(first_ms, last_ms + 1):
            supervisor.watch_stop(v, ms * self.MS)

    def test_an_arm_that_is_not_at_rest_in_time(self, stopped):
        due = round(1000 * SETTINGS.rest_within)
        self.watch(stopped, self.SLOW, 0, due - 1)
        assert (stopped.mode, stopped.stop_reason) == (Mode.STOPPED, "pushed")
        self.watch(stopped, self.SLOW, due, due)
        assert stopped.mode is Mode.SILENT
        expected = "pushed; lbr_A5 still moves with 0.10 rad/s 500 ms after the stop; nothing is commanded any more"
        assert stopped.stop_reason.startswith(expected)
        self.watch(stopped, REST, due + 1, due + 100)
        stopped.stop("again")
        assert stopped.stop_reason.startswith("pushed; ") and stopped.mode is Mode.SILENT
        assert stopped.happens(Event.RESET)
        assert (stopped.mode, stopped.stop_reason) == (Mode.HOLDING, "")

    def test_an_arm_that_rested_may_be_moved_by_hand_but_not_fast(self, stopped):
        self.watch(stopped, REST, 0, 600)
        self.watch(stopped, SETTINGS.stop_speed_gain * np.eye(7)[1], 601, 2000)
        assert stopped.mode is Mode.STOPPED
        self.watch(stopped, -1.01 * SETTINGS.stop_speed_gain * np.eye(7)[1], 2001, 2000 + SETTINGS.velocity_debounce)
        assert stopped.mode is Mode.SILENT
        assert "in the stop lbr_A2 got faster" in stopped.stop_reason

    def test_an_arm_that_slows_down_is_left_to_the_compliant_stop(self, stopped):
        for ms in range(400):
            stopped.watch_stop(np.full(7, 1.0 - ms / 400), ms * self.MS)
        self.watch(stopped, REST, 400, 3000)
        assert (stopped.mode, stopped.stop_reason) == (Mode.STOPPED, "pushed")

    def test_each_stop_has_its_own_time(self, stopped):
        self.watch(stopped, REST, 0, 5000)
        stopped.happens(Event.RESET)
        stopped.stop("pushed again")
        self.watch(stopped, self.SLOW, 9000, 9000 + round(1000 * SETTINGS.rest_within) - 1)
        assert stopped.mode is Mode.STOPPED

    def test_joint_states_that_the_observer_distrusts(self, supervisor):
        supervisor.observer_report("too much torque", 0)
        assert supervisor.mode is Mode.STOPPED
        supervisor.observer_report("too much torque", 1, "encoder stuck")
        assert supervisor.mode is Mode.SILENT
        assert supervisor.stop_reason.startswith("too much torque; encoder stuck; nothing is commanded")
        moving = Supervisor(SETTINGS)
        moving.happens(Event.START)
        moving.observer_report("encoder stuck", 0, "encoder stuck")
        assert moving.mode is Mode.SILENT
        assert moving.stop_reason.startswith("encoder stuck; nothing is commanded")


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_joint_that_is_too_fast_for_some_states_in_a_row_stops_the_arm(supervisor, joint, side):
    fast = np.where(np.arange(7) == joint, side * 1.01 * LIMITS, 0.0)
    for _ in range(SETTINGS.velocity_debounce - 1):
        supervisor.watch_joints(HOME, fast)
    supervisor.watch_joints(HOME, REST)
    for _ in range(SETTINGS.velocity_debounce - 1):
        supervisor.watch_joints(HOME, fast)
    assert supervisor.mode is Mode.HOLDING
    supervisor.watch_joints(HOME, fast)
    assert supervisor.mode is Mode.STOPPED
    name, speed = iiwa14.JOINT_NAMES[joint], 1.01 * LIMITS[joint]
    assert supervisor.stop_reason == f"{name} moves with {speed:.2f} rad/s, permitted {LIMITS[joint]:.2f} rad/s"


def test_speeds_up_to_the_limit_are_permitted(supervisor):
    for _ in range(100):
        supervisor.watch_joints(HOME, -LIMITS)
    assert supervisor.mode is Mode.HOLDING


@pytest.mark.parametrize("joint", range(7))
def test_a_joint_beyond_its_position_limit_stops_the_arm_and_keeps_it_stopped(supervisor, joint):
    limit = iiwa14.POSITION_LIMITS[joint]
    q = HOME.copy()
    q[joint] = -limit + 1e-6
    supervisor.watch_joints(q, REST)
    assert supervisor.mode is Mode.HOLDING
    q[joint] = -limit - 1e-3
    supervisor.watch_joints(q, REST)
    assert f"{iiwa14.JOINT_NAMES[joint]} at {q[joint]:.3f} rad is beyond its position limit" in supervisor.stop_reason
    with pytest.raises(InputError, match="beyond the position limit; move the arm back by hand"):
        supervisor.check_reset(q, REST, 0)
