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


@pytest.mark.parametrize("mode", Mode)
def test_every_state_but_stopped_itself_can_be_stopped_and_only_reset_leads_out(mode):
    if mode is not Mode.STOPPED:
        assert TRANSITIONS[mode, Event.STOP] is Mode.STOPPED
    assert [event for (start, event) in TRANSITIONS if start is Mode.STOPPED] == [Event.RESET]


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
