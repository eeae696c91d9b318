"""Distances of the arm from rigid bodies and from itself, and goals that are refused for them."""

import dataclasses
import re

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from six_axis import SIX_AXIS

from contact_reach_ros.arm import link_frames, rotation_about
from contact_reach_ros.arm.capsules import self_pairs, shape_radii, shape_segments, shapes
from contact_reach_ros.errors import InputError
from contact_reach_ros.world.collision import GOAL_CLEARANCE, body_distances, check_hand, nearest
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Block, Plane

DOWN = link_frames(ARM, HOME)[0][-1]
TABLE = Block("table", (0.5, 0.0, 0.1), (0.4, 0.6, 0.2))
BELOW_TIP = 0.045
"""How far the hand reaches beyond the flange, m."""


def links_of(arm) -> list[tuple[int, int]]:
    return [(shapes(arm)[first].link, shapes(arm)[second].link) for first, second in self_pairs(arm)]


def test_the_iiwa_touches_itself_with_forearm_and_hand_at_the_base():
    assert links_of(ARM) == [(0, 5), (0, 6), (0, 7)]
    assert links_of(SIX_AXIS) == [(0, 4), (0, 5)]


@pytest.mark.parametrize(
    "body",
    [
        Plane("wall", (0.3, 0.1, 0.0), (1.0, -2.0, 0.5)),
        Block("box", (0.1, 0.2, 0.0), (0.3, 0.2, 0.1), (0.1, 0.7, 0.1, 0.7)),
    ],
)
def test_the_distance_of_a_segment_is_that_of_its_nearest_point(body):
    random = np.random.default_rng(0)
    starts, ends = random.uniform(-0.6, 0.6, (2, 200, 3))
    shares = np.linspace(0.0, 1.0, 2001)[:, None, None]
    sampled = body.distances(starts + shares * (ends - starts)).min(axis=0)
    np.testing.assert_allclose(body_distances(body, starts, ends), sampled, atol=1e-3)


def test_depth_in_a_block_is_that_to_its_nearest_face():
    assert TABLE.distances(np.array([0.5, 0.0, 0.17])) == pytest.approx(-0.03)
    assert TABLE.distances(np.array([0.8, 0.0, 0.3])) == pytest.approx(np.hypot(0.1, 0.1))


def test_the_nearest_pair_is_named_with_its_distance():
    floor = Plane("floor", (0.0, 0.0, 0.1))
    (found,) = nearest(ARM, HOME[None], (floor, Plane("wall", (-2.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
    starts, ends = shape_segments(ARM, HOME[None])
    lowest = (np.minimum(starts, ends)[0, 1:, 2] - shape_radii(ARM)[1:]).min() - 0.1
    assert found.distance == pytest.approx(lowest)
    assert str(found) == f"lbr_link_7 is {1000 * lowest:.1f} mm away from the floor"


UP = rotation_about((0.0, 1.0, 0.0), np.pi) @ DOWN
TURNED = dataclasses.replace(ARM, tip_rotation=(0.8, 0.3, -0.4, 0.2))
"""An arm with other axes of the tip."""
ON_TOP = 0.2 + BELOW_TIP + GOAL_CLEARANCE
"""Least height of the flange above the table with the hand down, m."""
REFUSED = [
    (
        ARM,
        (0.5, 0.0, 0.23),
        DOWN,
        "lbr_link_7 lies 15.0 mm deep in the table; expected at least 5 mm between them: move",
    ),
    (TURNED, (0.5, 0.0, 0.23), link_frames(TURNED, HOME)[0][-1], "move the goal by 20.0 mm or turn"),
    (ARM, (0.5, 0.0, 0.255), UP, "lies 60.0 mm deep in the table"),
    # Without an orientation only what none avoids is refused.
    (ARM, (0.5, 0.0, ON_TOP - 1e-3), None, "lbr_link_7 is 4.0 mm away from the table"),
    (ARM, (0.15, 0.0, 0.2), DOWN, "lies 20.0 mm deep in lbr_link_0"),
]
ACCEPTED = [((0.5, 0.0, ON_TOP + 1e-6), DOWN), ((0.5, 0.0, ON_TOP + 1e-3), None), ((0.2, 0.0, ON_TOP), DOWN)]


@pytest.mark.parametrize(("arm", "position", "rotation", "said"), REFUSED)
def test_a_goal_with_the_hand_in_a_body_or_the_arms_base_is_refused_with_numbers(arm, position, rotation, said):
    with pytest.raises(InputError, match=re.escape(said)):
        check_hand(arm, Target(np.array(position), rotation), (TABLE,))


@pytest.mark.parametrize(("position", "rotation"), ACCEPTED)
def test_a_goal_beside_bodies_is_accepted(position, rotation):
    check_hand(ARM, Target(np.array(position), rotation), (TABLE,))
