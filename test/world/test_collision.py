"""Distances of the arm from rigid bodies and from itself, and goals that are refused for them."""

import dataclasses
import re

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from six_axis import SIX_AXIS

from contact_reach_ros.arm.capsules import self_pairs, shape_radii, shape_segments, shapes
from contact_reach_ros.arm.kinematics import link_frames, rotation_about
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


class TestGoals:
    def test_one_beneath_the_table_top_is_refused_with_numbers(self):
        message = (
            "goal: position = [0.5, 0.0, 0.22] m; there lbr_link_7 lies 25.0 mm deep in the table; expected at least "
            "5 mm between them: move the goal by 30.0 mm or turn the hand"
        )
        with pytest.raises(InputError, match=re.escape(message)):
            check_hand(ARM, Target(np.array([0.5, 0.0, 0.22]), DOWN), (TABLE,))
        above = np.array([0.5, 0.0, 0.2 + BELOW_TIP + GOAL_CLEARANCE + 1e-6])
        check_hand(ARM, Target(above, DOWN), (TABLE,))
        up = rotation_about((0.0, 1.0, 0.0), np.pi) @ DOWN
        with pytest.raises(InputError, match=r"lies 6\d\.\d mm deep in the table"):
            check_hand(ARM, Target(above, up), (TABLE,))

    def test_without_an_orientation_only_what_none_avoids_is_refused(self):
        position = np.array([0.5, 0.0, 0.2 + BELOW_TIP + GOAL_CLEARANCE - 1e-3])
        with pytest.raises(InputError, match=r"there lbr_link_7 is 4\.0 mm away from the table"):
            check_hand(ARM, Target(position), (TABLE,))
        check_hand(ARM, Target(position + np.array([0.0, 0.0, 2e-3])), (TABLE,))

    def test_the_hand_must_not_be_in_the_arms_own_base(self):
        with pytest.raises(InputError, match=r"lbr_link_7 lies 20\.0 mm deep in lbr_link_0"):
            check_hand(ARM, Target(np.array([0.15, 0.0, 0.2]), DOWN), ())
        check_hand(ARM, Target(np.array([0.2, 0.0, 0.2]), DOWN), ())

    def test_a_goal_places_the_hand_whatever_the_axes_of_the_tip(self):
        arm = dataclasses.replace(ARM, tip_rotation=(0.8, 0.3, -0.4, 0.2))
        rotation = link_frames(arm, HOME)[0][-1]
        for goal, whose in (
            (Target(np.array([0.5, 0.0, 0.23]), DOWN), ARM),
            (Target(np.array([0.5, 0.0, 0.23]), rotation), arm),
        ):
            with pytest.raises(InputError, match=r"lies 15\.0 mm deep in the table"):
                check_hand(whose, goal, (TABLE,))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane("floor", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "floor: normal"),
        (lambda: Block("table", (0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), "table: size"),
        (lambda: Block("table", np.zeros(3), np.ones(3), np.ones(4)), "table: orientation"),
    ],
)
def test_what_is_no_body_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
