"""The static contact model against closed forms, and the gentlest way against postures that are known."""

import numpy as np
import pytest
from arm_simulation import ARM

import contact_reach_ros as cr
from contact_reach_ros.experiments.floor import Search, StaticContact, floor
from contact_reach_ros.world.overlap import capsule_segments, overlap_depths, radii
from contact_reach_ros.world.spheres import Spheres

SURFACE = 1000.0
HOME = np.array(ARM.home)


def spheres(centers, stiffness=100.0, edges=()):
    count = len(centers)
    return Spheres(
        np.array(centers),
        np.array(centers),
        np.full(count, 0.05),
        np.full(count, stiffness),
        np.ones(count),
        np.array(edges, int).reshape(-1, 2),
        np.full(len(edges), 50.0),
    )


@pytest.fixture(scope="module")
def beside():
    """A link's radius, a point on its capsule far from the others, and the direction out of it, across its axis."""
    starts, ends = capsule_segments(ARM, HOME)
    found = []
    for index, axis in enumerate(ends - starts):
        out = np.cross(axis, [0.6, 0.64, 0.48])
        out /= np.linalg.norm(out)
        middle = 0.5 * (starts[index] + ends[index])
        points = np.array([middle + sign * (radii(ARM)[index] + 0.05) * out for sign in (1.0, -1.0)])
        depths = overlap_depths(ARM, starts, ends, points, 0.05)
        found.append((np.delete(depths, index, axis=0).max(), index, middle, out))
    depth, index, middle, out = min(found, key=lambda each: each[0])
    assert depth < -0.02
    return radii(ARM)[index], middle + radii(ARM)[index] * out, out


def test_a_sphere_yields_as_its_spring_and_its_surface_in_series(beside):
    _, point, out = beside
    for depth in (0.01, -0.01):
        found = StaticContact(ARM, spheres([point + (0.05 - depth) * out]), SURFACE).force(HOME)
        expected = max(depth, 0.0) / (1.0 / 100.0 + 1.0 / SURFACE)
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-9)


def test_opposite_pushes_cancel_as_in_the_simulation(beside):
    radius, point, out = beside
    other = point - 2.0 * radius * out
    pair = spheres([point + 0.04 * out, other - 0.04 * out])
    assert StaticContact(ARM, pair, SURFACE).force(HOME) == pytest.approx(0.0, abs=1e-6)


def test_what_a_sphere_is_joined_to_holds_it_too(beside):
    _, point, out = beside
    far = point + 1.0 * out
    alone, joined = (
        StaticContact(ARM, spheres([point + 0.04 * out, far], edges=edges), SURFACE).force(HOME)
        for edges in ((), [(0, 1)])
    )
    # The other sphere's spring and the edge in series, beside its own.
    stiffness = 100.0 + 1.0 / (1.0 / 50.0 + 1.0 / 100.0)
    assert joined == pytest.approx(0.01 / (1.0 / stiffness + 1.0 / SURFACE), rel=1e-3)
    assert joined > alone


def test_nothing_is_in_the_way_at_a_ball_and_something_behind_the_walls():
    small = Search(stations=2, seeds=20, generations=4)
    assert max(each.force for each in floor(cr.load_scene("ball", seed=0), SURFACE, small, 0)) == 0.0
    goal = floor(cr.load_scene("wall", seed=0), SURFACE, small._replace(stations=1), 0)[-1]
    assert (goal.share, goal.force > 0.0) == (1.0, True)
