"""Plans arrive in two halves, in any order, and live until their last knot."""

import math

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.control.follower import blend
from contact_reach_ros.control.references import PoseKnots, PostureKnots, Reference, ReferenceQueue
from contact_reach_ros.errors import InputError

MS = 1_000_000
LEAD = 1.0


@pytest.fixture
def queue() -> ReferenceQueue:
    return ReferenceQueue(ARM.n, LEAD)


def poses(stamp_ms: float, ends_ms: tuple[float, ...] = (100, 200, 300), value: float = 0.0) -> PoseKnots:
    """Knot i lies at x = value + i."""
    count = len(ends_ms)
    positions = np.array([[value + index, 0.0, 0.0] for index in range(count)]).reshape(-1, 3)
    ends = tuple(int(end * MS) for end in ends_ms)
    return PoseKnots(int(stamp_ms * MS), ends, positions, np.tile(np.eye(3), (count, 1, 1)))


def postures(stamp_ms: float, ends_ms: tuple[float, ...] = (100, 200, 300), value: float = 0.0) -> PostureKnots:
    values = np.array([np.full(ARM.n, value + index) for index in range(len(ends_ms))]).reshape(-1, 7)
    return PostureKnots(int(stamp_ms * MS), tuple(int(end * MS) for end in ends_ms), values)


def offer(queue: ReferenceQueue, stamp_ms: float, now_ms: float, value: float = 0.0) -> None:
    queue.offer_poses(poses(stamp_ms, value=value), int(now_ms * MS))
    queue.offer_postures(postures(stamp_ms, value=value), int(now_ms * MS))


def selected(queue: ReferenceQueue, now_ms: float) -> float | None:
    """The x of the reference in force; its posture must be that of the same knot."""
    reference = queue.select(int(now_ms * MS))
    if reference is None:
        return None
    assert (reference.posture == reference.position[0]).all()
    return float(reference.position[0])


@given(st.permutations([(kind, stamp) for kind in ("pose", "posture") for stamp in (10, 20, 30)]))
def test_halves_pair_in_any_order(order):
    queue = ReferenceQueue(ARM.n, LEAD)
    for kind, stamp in order:
        if kind == "pose":
            queue.offer_poses(poses(stamp, value=stamp), 0)
        else:
            queue.offer_postures(postures(stamp, value=stamp), 0)
    assert queue.accepted == 3
    assert queue.unpaired == 0
    assert [selected(queue, now) for now in (5, 10, 20, 30)] == [None, 10, 20, 30]


@pytest.mark.parametrize("empty_half", ["poses", "postures"])
def test_an_empty_half_withdraws_every_plan_that_came_before_it_and_none_that_comes_later(queue, empty_half):
    for stamp in (0, 50):
        offer(queue, stamp, 0)
    assert selected(queue, 10) == 0.0
    if empty_half == "poses":
        queue.offer_poses(poses(0, ()), 10 * MS)
    else:
        queue.offer_postures(postures(0, ()), 10 * MS)
    assert [selected(queue, now) for now in (10, 60)] == [None, None]
    offer(queue, 70, 60, value=5.0)
    assert selected(queue, 80) == 5.0


def test_halves_that_stay_alone_are_dropped_and_counted(queue):
    for stamp in range(30):
        queue.offer_poses(poses(stamp), stamp * MS)
        queue.offer_postures(postures(stamp + 0.5), stamp * MS)
    assert queue.accepted == 0
    assert 40 <= queue.unpaired <= 60
    # The first half is gone: its other one comes too late.
    queue.offer_postures(postures(0), 30 * MS)
    assert queue.accepted == 0
    # Ordinary plans still pass.
    offer(queue, 40, 40, value=7.0)
    assert selected(queue, 40) == 7.0


def test_clock_that_is_set_back_does_not_prolong_a_plan(queue):
    offer(queue, 1000, 1000, value=1.0)
    assert selected(queue, 1100) == 2.0
    assert selected(queue, 500) is None
    offer(queue, 510, 510, value=5.0)
    assert selected(queue, 520) == 5.0


@given(st.integers(-50, 600), st.lists(st.integers(1, 100), min_size=1, max_size=5))
def test_a_knot_is_in_force_from_the_end_of_the_one_before_it_to_its_own(elapsed, durations):
    ends, queue = tuple(np.cumsum(durations).tolist()), ReferenceQueue(ARM.n, LEAD)
    queue.offer_poses(poses(50, ends), 0)
    queue.offer_postures(postures(50, ends), 0)
    knot = next((knot for knot, end in enumerate(ends) if elapsed < end), None)
    assert selected(queue, 50 + elapsed) == (knot if elapsed >= 0 else None)


def test_halves_with_different_times_are_refused(queue):
    queue.offer_poses(poses(0), 0)
    with pytest.raises(InputError, match="different time_from_start"):
        queue.offer_postures(postures(0, (100, 200, 400)), 0)
    assert queue.select(50 * MS) is None


HALVES = {"reference/pose": (poses, "offer_poses"), "reference/posture": (postures, "offer_postures")}


@pytest.mark.parametrize("field", HALVES)
@pytest.mark.parametrize(
    ("stamp_ms", "ends_ms", "now_ms", "value", "match"),
    [
        (1500, (100, 200), 0, 2.0, r"header\.stamp.*1\.500 s in the future.*at most 1 s"),
        (10, (100, 200), 210, 2.0, r"last knot ended 0\.000 s ago"),
        (0, (100, 100, 200), 0, 2.0, "time_from_start.*strictly increasing"),
        (0, (-50, 100, 200), 0, 2.0, "time_from_start.*strictly increasing"),
        (0, (100, 200), 0, math.nan, "finite"),
    ],
)
def test_a_half_is_refused_before_it_changes_anything(queue, field, stamp_ms, ends_ms, now_ms, value, match):
    offer(queue, 0, 0, value=1.0)
    make, offer_half = HALVES[field]
    with pytest.raises(InputError, match=f"^{field}: .*{match}"):
        getattr(queue, offer_half)(make(stamp_ms, ends_ms, value), now_ms * MS)
    assert queue.accepted == 1 and selected(queue, 0) == 1.0


@given(st.floats(0.0, 1.0))
def test_blend_goes_straight_from_one_reference_to_the_other(share):
    turn = np.array([0.3, -0.8, 1.2])
    start = Reference(np.array([0.1, 0.2, 0.3]), pin.exp3(np.array([1.0, 0.5, -2.0])), np.arange(7.0))
    end = Reference(np.array([0.5, -0.2, 0.6]), pin.exp3(turn) @ start.rotation, -np.arange(7.0))
    between = blend(start, end, share)
    np.testing.assert_allclose(between.position, (1 - share) * start.position + share * end.position, atol=1e-12)
    np.testing.assert_allclose(between.posture, (1 - share) * start.posture + share * end.posture, atol=1e-12)
    np.testing.assert_allclose(between.rotation, pin.exp3(share * turn) @ start.rotation, atol=1e-12)
