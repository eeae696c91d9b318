"""Arms with five joints and fewer: the task that they can hold, and scenes for it."""

import numpy as np
import pytest
from arm_simulation import ARM
from few_joints import few_joints
from scipy.spatial.transform import Rotation
from six_axis import SIX_AXIS

from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.kinematics import AXIS, POSE, POSITION
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import make_settings
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.scenes.placing import free_path
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import Goal

FIVE, ROLL, FOUR, THREE = "zyyzy", "zyyyz", "zyyy", "zyy"
"""Axes of arms; the last joint of `ROLL` turns about the tip's z axis, whose direction the others cannot hold."""


def task_in(arm, **values: str) -> str:
    given = {f"impedance.{name}": value for name, value in values.items()}
    return make_settings(given, CONTROLLER_SECTIONS, arm, "arm.yaml: controller")["impedance"].task


@pytest.mark.parametrize(
    ("axes", "sideways", "task"),
    [
        (FIVE, False, AXIS),
        (ROLL, False, POSITION),
        (ROLL, True, AXIS),
        (FOUR, False, POSITION),
        (THREE, False, POSITION),
    ],
)
def test_the_default_task_is_what_the_joints_can_hold(axes, sideways, task):
    arm = few_joints(axes, sideways)
    assert arm.task == task_in(arm) == task
    assert task_in(arm, task=POSITION) == POSITION


def test_six_joints_and_more_hold_a_pose():
    assert ARM.task == SIX_AXIS.task == task_in(ARM) == POSE


@pytest.mark.parametrize(
    ("axes", "task", "expected"),
    [
        (FIVE, POSE, "pose has 6 rows, but the arm's 5 joints can hold 5; expected one of auto, position_and_axis, "),
        (ROLL, AXIS, "position_and_axis has 5 rows, but the arm's 5 joints can hold 3; expected one of auto, po"),
        (FOUR, POSE, "pose has 6 rows, but the arm's 4 joints can hold 3; expected one of auto, position"),
    ],
)
def test_a_task_that_the_arm_cannot_hold_is_refused(axes, task, expected):
    with pytest.raises(SettingsError, match=f"arm.yaml: controller: impedance.task = {expected}"):
        task_in(few_joints(axes), task=task)


@pytest.mark.parametrize(("axes", "count"), [("zy", 2), ("yyy", 3)])
def test_an_arm_that_cannot_hold_a_position_is_refused(axes, count):
    with pytest.raises(
        SettingsError, match=rf"the {count} joints of arm '{axes}' move its tip in 2 directions; .* 3 r"
    ):
        few_joints(axes)
    with pytest.raises(SettingsError, match=r"expected at least the 3 rows of impedance.task = position: free joints"):
        task_in(few_joints(axes, home=(0.5,) * count))


@pytest.mark.parametrize("name", ["free", "ball"])
@pytest.mark.parametrize("axes", [FIVE, ROLL, FOUR])
def test_targets_are_reached_with_the_task_held(axes, name):
    arm = few_joints(axes)
    for seed in range(3):
        scene = load_scene(name, arm, seed)
        path = free_path(RobotModel(arm), scene.start, scene.target)
        poses = [link_frames(arm, q) for q in path]
        np.testing.assert_allclose(poses[-1][1][-1], scene.target, atol=1e-3)
        if arm.task == AXIS:
            held = np.array([rotations[-1][:, 2] for rotations, _ in poses])
            assert np.linalg.norm(held - held[0], axis=1).max() < 5e-3
        assert len(scene.obstacles) == (name == "ball")


def test_goals_count_as_far_as_the_arm_can_hold_them():
    turned, rotation = Rotation.from_euler("xyz", [0.3, 0.0, 1.0]), np.eye(3)
    for arm in (few_joints(FOUR), few_joints(FIVE)):
        position = RobotModel(arm).tip_pose(np.array(arm.home))[0]
        target = Goal(position, turned.as_quat()).resolve(arm, rotation)
        assert (target.rotation is None) == (arm.task == POSITION)
        # Of the turn about z nothing counts with five joints, and of the whole turn nothing with four.
        assert target.angle(rotation) == pytest.approx(0.3 if arm.task == AXIS else 0.0, abs=1e-6)
        held = Goal(position).resolve(arm, RobotModel(arm).tip_pose(np.array(arm.home))[1])
        check_goal(arm, held, (), np.array(arm.home))
