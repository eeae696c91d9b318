"""A tool that every part of the stack knows, and one that only the robot has."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, WITH_TOOL
from planning_helpers import SMALL

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.goal import Goal

REST_MS = 500
LONGEST_MS = 3000


def stack_for(arm: Arm, **planner) -> Stack:
    """A stack that believes in `arm`, and a robot with the tool."""
    scene = load_scene("free", arm=arm)
    robot = SimulatedRobot(dataclasses.replace(scene, arm=WITH_TOOL), noise_seed=0)
    return Stack(scene, robot=robot, **planner)


@pytest.mark.slow
def test_with_the_tool_known_its_tip_reaches_the_goal_and_rests_without_residual():
    stack = stack_for(WITH_TOOL, planning=SMALL)
    result = stack.run(Goal(stack.scene.target), linger=0.001 * REST_MS)
    assert result.reached
    plant = stack.robot.plant
    assert np.linalg.norm(plant.tip_position - stack.scene.target) <= 0.01
    bare = RobotModel(ARM).tip_pose(plant.data.qpos[: ARM.n])[0]
    assert np.linalg.norm(bare - stack.scene.target) > 0.15
    # What is left is the friction that the drive does not report.
    assert np.abs(stack.observer.momentum.residual).max() < 1.0


def test_an_unknown_tool_is_the_residual_and_not_carried(planner):
    stack = stack_for(ARM, planner=planner)
    for _ in range(LONGEST_MS):
        stack.step()
        if stack.stop_reason:
            break
    weight = RobotModel(WITH_TOOL).gravity_at(stack.state.q) - RobotModel(ARM).gravity_at(stack.state.q)
    assert np.abs(weight).max() > 10.0
    np.testing.assert_allclose(stack.observer.momentum.residual, -weight, atol=1.5)
    assert "gravity or payload does not match the arm" in stack.stop_reason
