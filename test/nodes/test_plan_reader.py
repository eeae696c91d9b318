"""The two messages of a plan arrive in any order, and the controller follows it when both are there."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS, UNWATCHED
from builtin_interfaces.msg import Duration
from hypothesis import given
from hypothesis import strategies as st
from plans import make_plan

from contact_reach_ros.control.controller import Controller
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.plan_reader import PlanReader
from contact_reach_ros.nodes.planner_output import to_references

POSE, POSTURE = "pose", "posture"
MS = TICK_NS


class Reading:
    """A started controller, and the reader that hands plans to it."""

    def __init__(self) -> None:
        self.controller = Controller(ARM, UNWATCHED)
        self.controller.start(HOME, REST, 0)
        self.reader = PlanReader(self.controller)
        self.position, self.rotation = self.controller.model.tip_pose(HOME)

    def messages(self, stamp_ms: int):
        """Both messages of a plan, whose postures are `stamp_ms` microradians from home."""
        plan = make_plan(
            np.tile(self.position, (3, 1)),
            np.tile(self.rotation, (3, 1, 1)),
            np.tile(HOME + 1e-6 * stamp_ms, (3, 1)),
            effect_ns=stamp_ms * MS,
        )
        return dict(zip((POSE, POSTURE), to_references(plan, ARM), strict=True))

    def take(self, kind: str, message) -> None:
        getattr(self.reader, {POSE: "take_poses", POSTURE: "take_postures"}[kind])(message)

    @property
    def accepted(self) -> int:
        return self.controller.follower.queue.accepted

    def followed(self, now_ms: int) -> float | None:
        """Stamp, ms, of the plan in force, from its postures."""
        found = self.controller.follower.queue.select(now_ms * MS)
        return None if found is None else round(1e6 * float(found.posture[0] - HOME[0]))


@pytest.fixture
def reading() -> Reading:
    return Reading()


@given(st.lists(st.permutations([POSE, POSTURE]), min_size=3, max_size=3))
def test_the_halves_of_one_plan_after_another_pair_in_any_order(orders):
    reading = Reading()
    for stamp, order in zip((10, 20, 30), orders, strict=True):
        for kind in order:
            reading.take(kind, reading.messages(stamp)[kind])
    assert reading.accepted == 3
    assert [reading.followed(now) for now in (5, 10, 20, 30)] == [None, 10, 20, 30]


def test_of_plans_that_come_at_once_the_newest_is_followed_and_the_loss_is_refused(reading):
    first, second = reading.messages(10), reading.messages(20)
    reading.take(POSE, first[POSE])
    with pytest.raises(InputError, match=r"^reference/pose: .* without its other half; expected .* the same stamp"):
        reading.take(POSE, second[POSE])
    reading.take(POSTURE, first[POSTURE])
    reading.take(POSTURE, second[POSTURE])
    assert [reading.followed(now) for now in (15, 25)] == [None, 20]


@pytest.mark.parametrize("empty", [POSE, POSTURE])
def test_an_empty_half_withdraws_every_plan_that_came_before_it_and_none_that_comes_later(reading, empty):
    for stamp in (0, 50):
        for kind, message in reading.messages(stamp).items():
            reading.take(kind, message)
    reading.take(POSE, reading.messages(60)[POSE])
    assert reading.followed(10) == 0
    nothing = reading.messages(0)[empty]
    nothing.points = []
    reading.take(empty, nothing)
    assert [reading.followed(now) for now in (10, 60)] == [None, None]
    for kind, message in reading.messages(70).items():
        reading.take(kind, message)
    assert reading.followed(80) == 70


def test_halves_with_different_times_are_refused_and_the_next_plan_is_not(reading):
    messages = reading.messages(0)
    messages[POSTURE].points[-1].time_from_start = Duration(nanosec=299_000_000)
    reading.take(POSE, messages[POSE])
    with pytest.raises(InputError, match="different time_from_start"):
        reading.take(POSTURE, messages[POSTURE])
    assert reading.followed(50) is None
    for kind, message in reading.messages(60).items():
        reading.take(kind, message)
    assert reading.followed(60) == 60
