"""Goals that follow each other: one goal that moves, or rests among noise."""

import itertools

import numpy as np
import pytest

from contact_reach_ros.planning.goal_stream import GoalStream
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import Target

RADIUS = 0.1
START = np.array([0.5, 0.0, 0.4])


def circle(time: float, speed: float) -> np.ndarray:
    angle = speed / RADIUS * time
    return START + RADIUS * np.array([np.cos(angle) - 1.0, np.sin(angle), 0.0])


def line(time: float, speed: float) -> np.ndarray:
    return START + np.array([0.0, speed * time, 0.0])


def ns(time: float) -> int:
    return round(time * NANOSECONDS)


def now(stream: GoalStream, time: float) -> Target:
    return stream.at(ns(time), ns(time))


def fed(times, place, speed) -> GoalStream:
    stream = GoalStream()
    for time in times:
        stream.take(Target(place(time, speed)), ns(time))
    return stream


@pytest.mark.parametrize("rate", [2.0, 10.0, 30.0, 100.0])
def test_a_goal_on_a_line_is_known_between_its_messages(rate):
    times = np.arange(0.0, 3.0, 1.0 / rate)
    goal = now(fed(times, line, 0.1), times[-1] + 0.9 / rate)
    np.testing.assert_allclose(goal.position, line(times[-1] + 0.9 / rate, 0.1), atol=1e-6)
    np.testing.assert_allclose(goal.velocity, [0.0, 0.1, 0.0], atol=1e-6)
    assert goal.moves


@pytest.mark.parametrize(("rate", "speed", "most"), [(20.0, 0.05, 0.002), (100.0, 0.1, 0.005), (2.0, 0.05, 0.015)])
def test_on_a_circle_with_jitter_and_gaps_it_stays_close(rate, speed, most):
    random = np.random.default_rng(0)
    times = np.arange(0.0, 6.0, 1.0 / rate) + random.uniform(-0.3, 0.3, round(6.0 * rate)) / rate
    times = times[random.random(len(times)) > 0.05]
    stream, errors = GoalStream(), []
    for time, following in itertools.pairwise(times):
        stream.take(Target(circle(time, speed)), ns(time))
        if time > 2.0:
            last = min(following, time + 1.4 / rate)
            errors.append(np.linalg.norm(now(stream, last).position - circle(last, speed)))
    assert np.mean(errors) < most


def test_noise_is_no_motion():
    random = np.random.default_rng(1)
    stream, moving = GoalStream(), []
    for step in range(400):
        stream.take(Target(START + 0.0015 * random.standard_normal(3)), ns(0.05 * step))
        goal = now(stream, 0.05 * step)
        moving.append(goal.moves)
    assert np.mean(moving) < 0.05


def test_it_rests_where_it_was_last_when_no_more_come():
    times = np.arange(0.0, 2.0, 0.05)
    stream = fed(times, line, 0.1)
    assert now(stream, times[-1] + 0.07).moves
    # Plans are for a later time than the present.
    assert stream.at(ns(times[-1] + 0.2), ns(times[-1] + 0.07)).moves
    ended = now(stream, times[-1] + 0.1)
    assert not ended.moves
    np.testing.assert_array_equal(ended.position, line(times[-1], 0.1))


@pytest.mark.parametrize("later", [0.05, 1.1])
def test_one_far_away_or_late_is_a_new_goal(later):
    stream = fed([0.0, 0.05, 0.1], line, 0.1)
    place = line(0.1, 0.1) + (0.1 if later < 1.0 else 0.0)
    assert not stream.take(Target(place), ns(0.1 + later))
    assert not now(stream, 0.1 + later).moves


def test_a_second_goal_nearby_is_a_new_one_and_a_third_goes_on():
    stream = GoalStream()
    assert [stream.take(Target(line(time, 0.1)), ns(time)) for time in (0.0, 0.3, 0.6)] == [False, False, True]


def test_goals_of_another_orientation_are_new_ones():
    stream = fed([0.0, 0.05, 0.1], line, 0.1)
    assert not stream.take(Target(line(0.15, 0.1), np.eye(3)), ns(0.15))


def test_of_several_at_one_time_the_last_counts():
    stream = fed([0.0, 0.05, 0.1, 0.15], line, 0.1)
    assert stream.take(Target(line(0.16, 0.1)), ns(0.15))
    goal = now(stream, 0.15)
    assert goal.moves and abs(goal.position[1] - line(0.16, 0.1)[1]) < 1e-3
