"""The scenes of the paper's authors: their numbers, their tip, and goals of a position only."""

import numpy as np
import pytest

from contact_reach_ros import Stack, load_scene
from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import load_arm
from contact_reach_ros.bringup.processes import processes
from contact_reach_ros.bringup.settings import BringupOptions


@pytest.mark.parametrize("name", ["slalom", "authors_ball", "authors_ball_high"])
def test_tip_is_that_of_their_gripper_and_any_orientation_will_do(name):
    scene = load_scene(name)
    rotations, origins = link_frames(scene.arm, scene.start)
    assert np.allclose(origins[-1] - origins[-2], 0.2975 * rotations[-2][:, 2], atol=1e-9)
    assert np.allclose(origins[-1][:2], [0.4, 0.0], atol=1e-6)
    stack = Stack(scene)
    assert stack.planner.resolve(scene.goal, stack.state).rotation is None


def test_boards_yield_at_their_outer_columns_only():
    first, second = load_scene("slalom").obstacles
    for board, center in ((first, [0.375, 0.23, 0.5]), (second, [0.6, -0.1, 0.5])):
        assert np.allclose(board.rest.mean(axis=0), center)
        outer = np.isclose(np.abs(board.rest[:, 1] - center[1]), 2 * 0.049)
        assert np.array_equal(board.fixed, ~outer)
        assert np.allclose(np.linalg.norm(np.diff(board.rest[board.edges], axis=1), axis=2), 0.049)


def test_nothing_moves_a_fixed_ball():
    (ball,) = load_scene("authors_ball").obstacles
    assert ball.fixed.all()


def test_bringup_gives_every_node_the_tool_and_the_planner_the_orientation():
    table = {process.name: process.parameters for process in processes(BringupOptions(scene="slalom"))}
    offset = [0.0, 0.0, 0.2525, 0.0, 0.0, 0.0]
    assert all(parameters["tool.flange_to_tip"] == offset for parameters in table.values())
    assert table["planner"]["goal_orientation"] == "free"
    assert not any("tool.flange_to_tip" in process.parameters for process in processes(BringupOptions(scene="wall")))


def test_a_tool_of_the_arm_itself_replaces_that_of_the_scene():
    own = load_arm().with_tool(Tool(flange_to_tip=(0.0, 0.0, 0.3, 0.0, 0.0, 0.0)))
    assert load_scene("slalom", own).arm == own
