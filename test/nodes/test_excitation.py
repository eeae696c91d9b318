"""The goals that the arm is moved through."""

import numpy as np
import pytest
from arm_simulation import ARM

from contact_reach_ros.bringup.excitation import check_clearance, goals
from contact_reach_ros.errors import InputError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Plane
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

HOME = np.array(ARM.home)


def obstacles(scene: str) -> Spheres:
    made = make_scene(read_scene(scene), ARM, 0)
    return obstacle_spheres(made, rest_positions(made))


def test_the_goals_are_reachable_above_the_floor_and_end_at_home():
    free = obstacles("free")
    check_clearance(ARM, HOME, free)
    for position, rotation in goals(ARM):
        check_goal(ARM, Target(position, rotation), free.environment, HOME)
    np.testing.assert_allclose(goals(ARM)[-1][0], goals(ARM)[0][0] - (0.0, 0.12, 0.05), atol=1e-12)


def test_an_obstacle_beside_the_arm_and_a_table_in_the_way_are_named():
    with pytest.raises(InputError, match=r"an obstacle would be .* m from the arm on the way to goal 1"):
        check_clearance(ARM, HOME, obstacles("ball"))
    table = Plane("table", (0.0, 0.0, 0.15))
    with pytest.raises(InputError, match=r"on the way to goal .* deep in the table"):
        check_clearance(ARM, HOME, Spheres.none((table,)))
