"""The state machine: what its table allows, and what stops the arm."""

import re
from pathlib import Path

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from contact_reach_ros.control.stop_watch import CREEP, REST_WITHIN, SPEED_DEBOUNCE, SPEED_GAIN

from contact_reach_ros.arm import REST_SPEED
from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.control.supervisor import TRANSITIONS, Event, Mode, Supervisor
from contact_reach_ros.errors import InputError, Verdict

LIMITS = np.array(ARM.velocity_limits)


@pytest.fixture
def supervisor() -> Supervisor:
    made = Supervisor(ARM, SupervisionSettings())
    made.happens(Event.START)
    return made


def test_the_picture_in_the_docs_is_the_table():
    page = (Path(__file__).parents[2] / "docs" / "safety.md").read_text()
    drawn = set(re.findall(r"^    (\w+) --> (\w+): (.+)$", page, re.MULTILINE))
    # What leaves a state as it is needs no arrow.
    table = {(start.name, end.name, event.value) for (start, event), end in TRANSITIONS.items() if start is not end}
    assert drawn == table


def test_events_that_do_not_belong_to_a_state_change_nothing():
    supervisor = Supervisor(ARM, SupervisionSettings())
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


class TestRest:
    """A stop ends in the drive's brakes: soon after the arm has come to rest, at once when it creeps or does not rest.

    Nothing is commanded any more then, and the reason tells both stories.
    """

    SLOW = 2.0 * REST_SPEED
    CREEPS = 0.8 * REST_SPEED

    def stopped(self, **settings) -> Supervisor:
        made = Supervisor(ARM, SupervisionSettings(**settings))
        made.happens(Event.START)
        made.stop("pushed")
        return made

    def watch(self, supervisor, speed, first_ms, last_ms, joint=4, moved=0.0):
        """Let a joint move at this speed from an angle beside home; returns how far it gets until something is said."""
        direction = np.eye(ARM.n)[joint]
        for ms in range(first_ms, last_ms + 1):
            supervisor.watch_stop(HOME + moved * direction, speed * direction, ms * 1_000_000)
            if supervisor.stop_reason != "pushed":
                break
            moved += speed / 1000
        return moved

    def test_an_arm_that_is_not_at_rest_in_time(self):
        stopped, due = self.stopped(), round(1000 * REST_WITHIN)
        self.watch(stopped, self.SLOW, 0, due - 1)
        assert (stopped.mode, stopped.stop_reason) == (Mode.STOPPED, "pushed")
        self.watch(stopped, self.SLOW, due, due)
        assert stopped.mode is Mode.SILENT
        expected = "pushed; lbr_A5 still moves with 0.10 rad/s 500 ms after the stop; nothing is commanded any more"
        assert stopped.stop_reason.startswith(expected)
        stopped.stop("again")
        assert stopped.stop_reason.startswith("pushed; ") and stopped.mode is Mode.SILENT

    def test_an_arm_that_rested_may_be_moved_by_hand_but_not_fast(self):
        stopped = self.stopped()
        self.watch(stopped, 0.0, 0, 600)
        moved = self.watch(stopped, SPEED_GAIN, 601, 1800)
        assert stopped.mode is Mode.STOPPED
        self.watch(stopped, -1.01 * SPEED_GAIN, 1801, 1800 + SPEED_DEBOUNCE, moved=moved)
        assert stopped.mode is Mode.SILENT
        assert "in the stop lbr_A5 got faster" in stopped.stop_reason

    def test_a_joint_that_creeps(self):
        stopped = self.stopped()
        assert CREEP < self.watch(stopped, self.CREEPS, 0, 2000) <= CREEP + 1e-4
        assert stopped.mode is Mode.SILENT
        expected = f"pushed; {ARM.joint_names[4]} has crept by 0.010 rad since it came to rest; nothing is commanded"
        assert stopped.stop_reason.startswith(expected)

    def test_an_arm_that_is_moved_by_hand_does_not_creep(self):
        stopped = self.stopped()
        self.watch(stopped, 0.0, 0, 599)
        moved = self.watch(stopped, 4.0 * REST_SPEED, 600, 999)
        self.watch(stopped, 0.0, 1000, 1500, moved=moved)
        assert (stopped.mode, stopped.stop_reason) == (Mode.STOPPED, "pushed")

    @pytest.mark.parametrize(
        ("speed", "reason"),
        [(0.0, ""), (0.8 * REST_SPEED, "lbr_A5 has crept by 0.010 rad"), (0.3, "still moves with 0.30 rad/s")],
    )
    def test_a_drive_without_brakes_is_never_left_alone(self, speed, reason):
        stopped = self.stopped(drive_brakes=False)
        self.watch(stopped, speed, 0, 5000)
        assert stopped.mode is Mode.STOPPED
        assert reason in stopped.stop_reason and ("support the arm" in stopped.stop_reason) == bool(reason)

    def test_joint_states_that_the_observer_distrusts(self, supervisor):
        supervisor.hear_observer(Verdict("too much torque"), 0)
        assert supervisor.mode is Mode.STOPPED
        supervisor.hear_observer(Verdict("too much torque", "encoder stuck"), 1)
        assert supervisor.mode is Mode.SILENT
        assert supervisor.stop_reason.startswith("too much torque; encoder stuck; nothing is commanded")


@pytest.mark.parametrize(("joint", "side"), [(0, -1.0), (6, 1.0)])
def test_a_joint_that_is_too_fast_for_some_states_in_a_row_stops_the_arm(supervisor, joint, side):
    fast = np.where(np.arange(ARM.n) == joint, side * 1.01 * LIMITS, 0.0)
    for v in (*[fast] * (SPEED_DEBOUNCE - 1), REST, *[fast] * (SPEED_DEBOUNCE - 1)):
        supervisor.watch_joints(HOME, v)
    assert supervisor.mode is Mode.HOLDING
    supervisor.watch_joints(HOME, fast)
    assert supervisor.mode is Mode.STOPPED
    name, speed = ARM.joint_names[joint], 1.01 * LIMITS[joint]
    assert supervisor.stop_reason == f"{name} moves with {speed:.2f} rad/s, permitted {LIMITS[joint]:.2f} rad/s"


@pytest.mark.parametrize("joint", [0, 6])
def test_a_joint_beyond_its_position_limit_stops_the_arm_and_keeps_it_stopped(supervisor, joint):
    q = np.where(np.arange(ARM.n) == joint, 1e-6 - np.array(ARM.upper), HOME)
    supervisor.watch_joints(q, REST)
    assert supervisor.mode is Mode.HOLDING
    q[joint] -= 1e-3
    supervisor.watch_joints(q, REST)
    assert f"{ARM.joint_names[joint]} at {q[joint]:.3f} rad is beyond its position limit" in supervisor.stop_reason
    with pytest.raises(InputError, match="beyond the position limit; move the arm back by hand"):
        supervisor.check_reset(q, REST, 0)
