import pytest
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.nodes.recorder import LossCounter


@given(first=st.integers(1, 10**6), arrived=st.lists(st.booleans(), min_size=1, max_size=60))
def test_gaps_of_one_publisher_are_counted(first: int, arrived: list[bool]) -> None:
    """What is missing between the first and the last message that arrived is lost, whatever the first number is."""
    numbers = [first + index for index, came in enumerate(arrived) if came]
    counter = LossCounter()
    for number in numbers:
        counter.count(number, lambda: 1)
    assert counter.lost == (numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0)
    assert counter.known


@given(st.data())
def test_publishers_that_interleave_lose_nothing(data: st.DataObject) -> None:
    publishers = data.draw(st.integers(2, 4))
    following = [data.draw(st.integers(1, 40)) for _ in range(publishers)]
    counter = LossCounter()
    for publisher in data.draw(st.lists(st.integers(0, publishers - 1), max_size=80)):
        counter.count(following[publisher], lambda: publishers)
        following[publisher] += 1
    assert counter.lost == 0


@pytest.mark.parametrize(
    ("arrived", "lost"),
    [
        # Two publishers, of which each has a gap.
        ([(1, 2), (1001, 2), (2, 2), (1002, 2), (5, 2), (1003, 2), (1010, 2)], 2 + 6),
        # One that starts again.
        ([(7, 1), (8, 1), (9, 1), (1, 1), (2, 1), (3, 1)], 0),
        # The last messages of two that have come equally far are taken when both are gone already.
        ([(2, 3), (5, 3), (5, 3), (6, 3), (6, 3), (7, 1), (7, 1), (3, 1)], 0),
    ],
)
def test_only_what_is_missing_is_lost(arrived: list[tuple[int, int]], lost: int) -> None:
    counter = LossCounter()
    for number, publishers in arrived:
        counter.count(number, lambda present=publishers: present)
    assert counter.lost == lost


def test_messages_without_numbers_make_the_count_unknown() -> None:
    counter = LossCounter()
    counter.count(None, lambda: 1)
    assert not counter.known
