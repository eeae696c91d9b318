"""A tool that every part of the stack knows."""

import numpy as np
import pytest
from arm_simulation import ARM, WITH_TOOL
from planning_helpers import SMALL

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.goal import Goal


@pytest.mark.slow
def test_its_tip_reaches_the_goal_and_the_arm_rests_without_residual():
    scene = load_scene("free", arm=WITH_TOOL)
    stack = Stack(scene, planning=SMALL)
    result = stack.run(Goal(scene.target))
    assert result.reached
    for _ in range(500):
        stack.step()
    plant = stack.robot.plant
    assert np.linalg.norm(plant.tip_position - scene.target) <= 0.01
    bare = RobotModel(ARM).tip_pose(plant.data.qpos[: ARM.n])[0]
    assert np.linalg.norm(bare - scene.target) > 0.15
    # What is left is the friction that the drive does not report.
    assert np.abs(stack.observer.momentum.residual).max() < 1.0
