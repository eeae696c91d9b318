"""Paths through joint space among soft and rigid bodies."""

import dataclasses
import itertools

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import ball_at

from contact_reach_ros.arm import link_frames
from contact_reach_ros.planning.paths import Statics, connect, duration, quickened
from contact_reach_ros.planning.transfer.contact import CONTACT_STIFFNESS
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

GOAL = HOME + np.array([0.8, 0.2, -0.3, 0.4, 0.2, -0.3, 0.5])
BETWEEN = link_frames(ARM, 0.5 * (HOME + GOAL))[1][-1]
LIMIT, STIFFNESS = 5.0, 300.0
MARGIN, ITERATIONS = 0.02, 200


def statics_among(spheres: Spheres) -> Statics:
    return Statics(ARM, spheres, HOME, Target(link_frames(ARM, GOAL)[1][-1]))


def between(path: np.ndarray) -> np.ndarray:
    return np.concatenate([a + np.linspace(0.0, 1.0, 200)[:, None] * (b - a) for a, b in itertools.pairwise(path)])


def path_among(statics: Statics, limit: float) -> np.ndarray:
    return connect(statics, np.array([GOAL, GOAL + 0.1]), limit, MARGIN, ITERATIONS, np.random.default_rng(0))[0]


def test_nothing_is_in_a_straight_way():
    np.testing.assert_allclose(path_among(statics_among(Spheres.none()), 0.0), [HOME, GOAL])


@pytest.mark.parametrize("limit", [0.0, LIMIT])
def test_a_path_leads_around_a_ball_to_a_goal_within_its_limit(limit):
    """Also between the postures that were looked at: half as far apart, they press no harder by more than that."""
    statics = statics_among(ball_at(BETWEEN, STIFFNESS))
    share, force = statics.reach(HOME, GOAL, limit)
    assert 0.0 < share < 1.0 and force <= limit
    path = path_among(statics, limit)
    quick = quickened(statics, path, limit, MARGIN, 60, np.random.default_rng(0))
    for each in (path, quick):
        np.testing.assert_allclose(each[0], HOME)
        assert min(np.abs(each[-1] - GOAL).max(), np.abs(each[-1] - GOAL - 0.1).max()) < 1e-9
        assert statics.forces(between(each)).max() <= limit + STIFFNESS * 0.01
        assert (each > ARM.lower + MARGIN - 1e-9).all() and (each < ARM.upper - MARGIN + 1e-9).all()
    assert duration(ARM, quick) < 0.9 * duration(ARM, path)


def test_there_is_none_past_a_ball_around_the_goals():
    assert path_among(statics_among(ball_at(link_frames(ARM, GOAL)[1][-1], 5000.0)), LIMIT) is None


def test_the_force_is_that_of_two_springs_in_series():
    elbow = link_frames(ARM, HOME)[1][3]
    shallow = ball_at(elbow, 100.0)
    deep = dataclasses.replace(shallow, radius=shallow.radius + 0.01)
    first, second = (statics_among(each).forces(HOME[None])[0] for each in (shallow, deep))
    assert second - first == pytest.approx(0.01 / (1 / 100 + 1 / CONTACT_STIFFNESS), rel=1e-3)
    assert statics_among(ball_at(elbow + np.array([0.0, 0.0, 3.0]), 100.0)).forces(HOME[None])[0] == 0.0


def test_forces_on_a_link_add_up_and_each_sphere_yields_by_itself():
    one = ball_at(BETWEEN, STIFFNESS)
    two = Spheres(
        **{name: np.concatenate([value] * 2) for name, value in vars(one).items() if isinstance(value, np.ndarray)}
    )
    first, both = statics_among(one), statics_among(two)
    posture = 0.5 * (HOME + GOAL)[None]
    assert first.forces(posture)[0] > 1.0
    assert both.forces(posture) == pytest.approx(2.0 * first.forces(posture))
    assert both.forces(posture, of_spheres=True) == pytest.approx(first.forces(posture))
