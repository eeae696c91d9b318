"""Tasks on several processes: their results and errors."""

import os

import pytest

from benchmarks.workers import run_each
from contact_reach_ros.errors import ContactReachError


def square(value: int) -> int:
    if value == 3:
        raise ValueError("three is refused")
    return value * value


def die(value: int) -> None:
    os._exit(value)


def test_every_task_comes_back_with_its_result_or_ends_the_run_with_its_error(capfd):
    assert sorted(run_each(square, [1, 2, 4], 2)) == [1, 4, 16]
    with pytest.raises(ValueError, match="three is refused"):
        list(run_each(square, [3], 1))
    with pytest.raises(ContactReachError, match="a worker's process died"):
        list(run_each(die, [1], 1))
    assert capfd.readouterr() == ("", "")
