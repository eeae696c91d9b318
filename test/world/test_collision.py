"""Distances of the arm from rigid bodies and from itself, and goals that are refused for them."""

import dataclasses
import re

import numpy as np
import pytest
from arm_simulation import ARM, HOME, rotation_about
from scipy.spatial.transform import Rotation
from six_axis import SIX_AXIS

from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.capsules import moving, self_pairs, shape_radii, shape_segments, shapes
from contact_reach_ros.errors import InputError
from contact_reach_ros.world.collision import GOAL_CLEARANCE, body_distances, check_hand, nearest, nearest_of
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Block, Plane, point_distances

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
    sampled = point_distances((body,), starts + shares * (ends - starts))[0].min(axis=0)
    np.testing.assert_allclose(body_distances(body, starts, ends), sampled, atol=1e-3)


def test_depth_in_a_block_is_that_to_its_nearest_face():
    assert point_distances((TABLE,), np.array([0.5, 0.0, 0.17])) == pytest.approx(-0.03)
    assert point_distances((TABLE,), np.array([0.8, 0.0, 0.3])) == pytest.approx(np.hypot(0.1, 0.1))


def test_of_many_bodies_the_nearest_are_those_of_a_search_in_each():
    random = np.random.default_rng(1)
    boxes = [
        Block(f"box {k}", random.uniform((-0.8, -0.8, 0.0), (0.8, 0.8, 1.0)), random.uniform(0.02, 0.3, 3), turn)
        for k, turn in enumerate(Rotation.random(20, random_state=0).as_quat())
    ]
    bodies = (Plane("floor", (0.0, 0.0, -0.1)), *boxes)
    q = random.uniform(ARM.lower, ARM.upper, (200, ARM.n))
    starts, ends = (points[:, moving(ARM)] for points in shape_segments(ARM, q))
    radii = shape_radii(ARM)[moving(ARM)]
    expected = np.array([(body_distances(body, starts, ends) - radii).min(axis=1) for body in bodies])
    found = nearest(ARM, q, bodies)
    own = np.array([pair.distance for pair in nearest(ARM, q, ())])
    np.testing.assert_array_equal([pair.distance for pair in found], np.minimum(expected.min(axis=0), own))
    named = {f"the {body.name}" for body in bodies}
    assert len({pair.other for pair in found} & named) > 10
    for posture in range(20):
        apart = [body_distances(box, starts[posture], ends[posture]).min() for box in boxes]
        by_hand = [boxes[index] for index in np.argsort(apart)[:2]]
        assert list(nearest_of(tuple(boxes), 2, starts[posture], ends[posture])) == by_hand


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
