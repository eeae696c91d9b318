"""The state machine: what its table allows, and what stops the arm."""

import re
from pathlib import Path

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST

from contact_reach_ros.arm import REST_SPEED
from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.control.supervisor import (
    OBSERVER,
    REST_TIME,
    SPEED_DEBOUNCE,
    STOP_TIME,
    YIELD_TIME,
    Event,
    Mode,
    Supervisor,
)
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
    rows = [event.value for event in Event]
    assert drawn == {(start.name, end.name, text) for text, starts, end in rows for start in starts if start is not end}


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


class TestContact:
    TOUCHED, STRONG = Verdict(contact="8 N at link"), Verdict(contact="15 N at link", excess=True)

    def watch(self, supervisor: Supervisor, verdict: Verdict, seconds: float) -> None:
        supervisor.hear(OBSERVER, verdict, supervisor.now_ns)
        supervisor.watch_contact(REST, supervisor.now_ns)
        supervisor.now_ns += round(seconds * 1e9)
        supervisor.watch_contact(REST, supervisor.now_ns)

    @pytest.mark.parametrize(
        ("is_tracking", "verdict", "mode"),
        [
            (False, TOUCHED, Mode.YIELDING),
            (True, TOUCHED, Mode.TRACKING),
            (True, STRONG, Mode.YIELDING),
            (False, Verdict(), Mode.HOLDING),
        ],
    )
    def test_the_arm_gives_way_unless_a_plan_is_in_force_and_the_force_permitted(
        self, supervisor, is_tracking, verdict, mode
    ):
        supervisor.now_ns = 0
        if is_tracking:
            supervisor.happens(Event.PLAN)
        self.watch(supervisor, verdict, 0.01)
        assert supervisor.mode is mode
        assert supervisor.is_passive == (mode is Mode.YIELDING)

    def test_then_it_is_held_again_or_stopped_if_the_contact_stays(self, supervisor):
        supervisor.now_ns = 0
        self.watch(supervisor, self.TOUCHED, YIELD_TIME - 0.01)
        assert supervisor.mode is Mode.YIELDING
        self.watch(supervisor, Verdict(), 0.02)
        assert supervisor.mode is Mode.HOLDING
        self.watch(supervisor, self.TOUCHED, YIELD_TIME)
        assert supervisor.mode is Mode.STOPPED
        assert supervisor.stop_reason.startswith("contact of 8 N at link has not ended")


class TestStop:
    """A stop ends in the drive's brakes once the arm rests, or soon in any case; where there are none it goes on."""

    FAST = 2.0 * REST_SPEED

    def stopped(self, **settings) -> Supervisor:
        made = Supervisor(ARM, SupervisionSettings(**settings))
        made.happens(Event.START)
        made.stop("pushed")
        return made

    def watch(self, supervisor, speed, first_ms, last_ms, joint=4):
        for ms in range(first_ms, last_ms + 1):
            supervisor.watch_stop(speed * np.eye(ARM.n)[joint], ms * 1_000_000)

    def test_an_arm_at_rest_is_braked_and_one_that_is_pushed_meanwhile_later(self):
        stopped, due = self.stopped(), round(1000 * REST_TIME)
        self.watch(stopped, self.FAST, 0, 99)
        self.watch(stopped, 0.0, 100, 200)
        self.watch(stopped, self.FAST, 201, 250)
        self.watch(stopped, 0.0, 251, 250 + due)
        assert (stopped.mode, stopped.stop_reason) == (Mode.STOPPED, "pushed")
        self.watch(stopped, 0.0, 251 + due, 251 + due)
        assert (stopped.mode, stopped.stop_reason) == (Mode.SILENT, "pushed")

    @pytest.mark.parametrize("settings", [{}, {"drive_brakes": False, "adapter": True}])
    def test_an_arm_that_does_not_rest_is_the_drives(self, settings):
        stopped, due = self.stopped(**settings), round(1000 * STOP_TIME)
        self.watch(stopped, self.FAST, 0, due - 1)
        assert (stopped.mode, stopped.stop_reason) == (Mode.STOPPED, "pushed")
        self.watch(stopped, self.FAST, due, due)
        assert stopped.mode is Mode.SILENT
        expected = "pushed; lbr_A5, with 0.10 rad/s, still moves 1 s after the stop; nothing is commanded any more"
        assert stopped.stop_reason.startswith(expected)
        stopped.stop("again")
        assert stopped.stop_reason.startswith("pushed; ") and stopped.mode is Mode.SILENT

    @pytest.mark.parametrize(("speed", "adapter"), [(0.0, True), (0.0, False), (FAST, False)])
    def test_a_drive_without_brakes_goes_on_holding(self, speed, adapter):
        """One that does not rest, too, where no adapter has another stop."""
        stopped = self.stopped(drive_brakes=False, adapter=adapter)
        self.watch(stopped, speed, 0, 5000)
        assert (stopped.mode, stopped.stop_reason) == (Mode.STOPPED, "pushed")

    def test_joint_states_that_the_observer_distrusts(self, supervisor):
        supervisor.hear(OBSERVER, Verdict("too much torque"), 0)
        assert supervisor.mode is Mode.STOPPED
        supervisor.hear(OBSERVER, Verdict("too much torque", "encoder stuck"), 1)
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
    with pytest.raises(InputError, match=r"beyond the position limit, at .* rad; move the arm back by hand"):
        supervisor.check_reset(q, REST, 0)
