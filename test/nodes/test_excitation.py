"""The goals that the arm is moved through."""

import numpy as np
from arm_simulation import ARM

from contact_reach_ros.bringup.excitation import goals
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

HOME = np.array(ARM.home)


def test_the_goals_are_reachable_above_the_floor_and_end_at_home():
    scene = make_scene(read_scene("free"), ARM, 0)
    free = obstacle_spheres(scene, rest_positions(scene))
    for position, rotation in goals(ARM):
        check_goal(ARM, Target(position, rotation), free.environment, HOME)
    np.testing.assert_allclose(goals(ARM)[-1][0], goals(ARM)[0][0] - (0.0, 0.12, 0.05), atol=1e-12)
