"""Plans wait for their stamp, and live until their last knot."""

import dataclasses
import math

import numpy as np
import pytest
from arm_simulation import ARM
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.control.references import ReferenceQueue, References
from contact_reach_ros.errors import InputError

MS = 1_000_000


@pytest.fixture
def queue() -> ReferenceQueue:
    return ReferenceQueue(ARM.n)


def plan(stamp_ms: float, ends_ms: tuple[float, ...] = (100, 200, 300), value: float = 0.0) -> References:
    """Knot i lies at x = value + i, and so do its joints."""
    count = len(ends_ms)
    positions = np.array([[value + index, 0.0, 0.0] for index in range(count)]).reshape(-1, 3)
    postures = np.array([np.full(ARM.n, value + index) for index in range(count)]).reshape(-1, 7)
    ends = tuple(int(end * MS) for end in ends_ms)
    return References(int(stamp_ms * MS), ends, positions, np.tile(np.eye(3), (count, 1, 1)), postures)


def offer(queue: ReferenceQueue, stamp_ms: float, now_ms: float, value: float = 0.0) -> None:
    queue.offer(plan(stamp_ms, value=value), int(now_ms * MS))


def selected(queue: ReferenceQueue, now_ms: float) -> float | None:
    """The x of the reference in force; its posture must be that of the same knot."""
    reference = queue.select(int(now_ms * MS))
    if reference is None:
        return None
    assert (reference.posture == reference.position[0]).all()
    return float(reference.position[0])


@given(st.permutations([10, 20, 30]))
def test_plans_that_come_early_wait_for_their_stamp_in_any_order(stamps):
    queue = ReferenceQueue(ARM.n)
    for stamp in stamps:
        offer(queue, stamp, 0, value=stamp)
    assert queue.accepted == 3
    assert [selected(queue, now) for now in (5, 10, 20, 30)] == [None, 10, 20, 30]


def test_what_is_forgotten_does_not_come_back_and_what_is_older_than_a_stop_is_refused(queue):
    for stamp in (0, 50):
        offer(queue, stamp, 0)
    queue.forget()
    assert [selected(queue, now) for now in (10, 60)] == [None, None]
    queue.clear(60 * MS)
    with pytest.raises(InputError, match="before the last stop"):
        offer(queue, 59, 60)
    offer(queue, 70, 60, value=5.0)
    assert selected(queue, 80) == 5.0


def test_clock_that_is_set_back_does_not_prolong_a_plan(queue):
    offer(queue, 1000, 1000, value=1.0)
    assert selected(queue, 1100) == 2.0
    assert selected(queue, 500) is None
    offer(queue, 510, 510, value=5.0)
    assert selected(queue, 520) == 5.0


@given(st.integers(-50, 600), st.lists(st.integers(1, 100), min_size=1, max_size=5))
def test_a_knot_is_in_force_from_the_end_of_the_one_before_it_to_its_own(elapsed, durations):
    ends, queue = tuple(np.cumsum(durations).tolist()), ReferenceQueue(ARM.n)
    queue.offer(plan(50, ends), 0)
    knot = next((knot for knot, end in enumerate(ends) if elapsed < end), None)
    assert selected(queue, 50 + elapsed) == (knot if elapsed >= 0 else None)


NAN = np.full((2, 7), math.nan)


@pytest.mark.parametrize(
    ("stamp_ms", "ends_ms", "now_ms", "changes", "match"),
    [
        (1500, (100, 200), 0, {}, "reference/pose: there is no joint state yet"),
        (1600, (100, 200), 100, {}, r"reference/pose: header\.stamp.*1\.500 s in the future.*at most 1 s"),
        (10, (100, 200), 210, {}, r"reference/pose: the last knot ended 0\.000 s ago"),
        (10, (100, 1200), 0, {}, r"reference/pose: the plan lasts 1\.2 s; expected at most 1 s"),
        (0, (100, 100), 0, {}, "reference/pose: time_from_start.*strictly increasing"),
        (0, (-50, 100), 0, {}, "reference/pose: time_from_start.*strictly increasing"),
        (0, (), 0, {}, "reference/pose: time_from_start"),
        (0, (100, 200), 0, {"positions": NAN[:, :3]}, "reference/pose: positions hold non-finite"),
        (0, (100, 200), 0, {"rotations": np.full((2, 3, 3), math.inf)}, "reference/pose: rotations hold non-finite"),
        (0, (100, 200), 0, {"postures": NAN}, "reference/posture: positions hold non-finite"),
        (0, (100, 200), 0, {"postures": NAN[:, :6]}, r"reference/posture: .* shape \(2, 6\); expected \(2, 7\)"),
        (0, (100, 200), 0, {"positions": np.zeros((3, 3))}, r"reference/pose: .* shape \(3, 3\); expected \(2, 3\)"),
    ],
)
def test_a_plan_is_refused_before_it_changes_anything(queue, stamp_ms, ends_ms, now_ms, changes, match):
    offer(queue, 0, 0, value=1.0)
    with pytest.raises(InputError, match=f"^{match}"):
        queue.offer(dataclasses.replace(plan(stamp_ms, ends_ms), **changes), now_ms * MS)
    assert queue.accepted == 1 and selected(queue, 0) == 1.0
