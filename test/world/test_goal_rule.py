"""One rule for goals, whoever asks: the planner's node, `Stack` or a scene."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from plans import StayingCore
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import JointState, link_frames
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.settings import ReplanningSettings, UnexpectedContactSettings
from contact_reach_ros.scenes.generate import load_scene, make_scene
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import FREE, HOLD, Goal, Target
from contact_reach_ros.world.scene_file import read_scene

ABOVE, NEAR = (0.0, 0.0, 1.15), (0.45, 0.2, 0.3)
"""Above the base the hand cannot point down: the joint limits are in the way."""


def by_the_node(position: tuple, orientation: str) -> None:
    settings = ReplanningSettings(require_obstacles=False)
    planner = Planner(ARM, None, settings, UnexpectedContactSettings())
    planner.request(JointState(1_000_000, HOME, np.zeros(ARM.n), None))
    planner.command(Goal(position, orientation))


def by_a_stack(position: tuple, orientation: str) -> None:
    Stack(load_scene("free"), planner=StayingCore()).command(Goal(position, orientation))


def by_a_scene(position: tuple, orientation: str) -> None:
    assert orientation == HOLD
    make_scene(read_scene("free"), ARM, 0, np.array(position))


@pytest.mark.parametrize("asked", [by_the_node, by_a_stack, by_a_scene])
def test_a_goal_that_no_posture_attains_is_refused(asked):
    with pytest.raises(ContactReachError, match=r"\[0.0, 0.0, 1.15\] m; no posture .* in this orientation: "):
        asked(ABOVE, HOLD)
    asked(NEAR, HOLD)


@pytest.mark.parametrize("asked", [by_the_node, by_a_stack, by_a_scene])
def test_a_goal_in_the_base_is_refused(asked):
    with pytest.raises(ContactReachError, match=r"\[0.0, 0.0, 0.1\] m; there .* deep in lbr_link_0"):
        asked((0.0, 0.0, 0.1), HOLD)


@pytest.mark.parametrize("asked", [by_the_node, by_a_stack])
def test_with_another_orientation_it_is_attained(asked):
    asked(ABOVE, FREE)


def test_poses_of_postures_are_attained():
    """At joint limits, too."""
    random = np.random.default_rng(0)
    for q in [*random.uniform(ARM.lower, ARM.upper, (50, ARM.n)), np.array(ARM.upper), np.array(ARM.lower)]:
        rotations, origins = link_frames(ARM, q)
        try:
            check_goal(ARM, Target(origins[-1], rotations[-1]), (), HOME)
        except InputError as error:
            assert "deep in lbr_link_0" in str(error)


TURN = np.array([0.1, 0.7, -0.1, 0.7])
TURN /= np.linalg.norm(TURN)


@pytest.mark.parametrize(
    "quaternion", [TURN, -TURN, 1.0005 * TURN, np.float32(TURN), TURN.round(4), TURN.round(3)], ids=repr
)
def test_quaternions_are_those_of_one_orientation_whatever_their_sign_and_rounding(quaternion):
    target = Goal(NEAR, quaternion).resolve(ARM, np.eye(3))
    assert target.angle(Rotation.from_quat(TURN).as_matrix()) < 2e-3


@pytest.mark.parametrize("quaternion", [0.0 * TURN, 2.0 * TURN, TURN * np.nan, TURN[:3], [0.0, 0.0, 0.7, 0.7, 0.0]])
def test_what_is_no_unit_quaternion_is_refused(quaternion):
    with pytest.raises(InputError, match=r"goal: orientation = .*; expected .*unit quaternion x, y, z, w"):
        Goal(NEAR, quaternion).resolve(ARM, np.eye(3))


@pytest.mark.parametrize(
    ("position", "said"),
    [
        ((500.0, 100.0, 350.0), r"position is \d+\.\d+ m from the shoulder .* the arm reaches 0.85 m"),
        ((1.5, 0.0, 0.3), r"position is 1.501 m from the shoulder"),
        ((np.nan, 0.0, 0.3), "position = .* expected three finite numbers x, y, z in m"),
        ((0.5, 0.1), "position = .* expected three finite numbers x, y, z in m"),
    ],
)
def test_what_is_no_place_for_the_tip_is_refused(position, said):
    with pytest.raises(InputError, match=f"goal: {said}"):
        Goal(position).resolve(ARM, np.eye(3))
