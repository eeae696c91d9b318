"""An arm with another number of joints, asymmetric limits and other capsules: nothing here is about the iiwa alone."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, IDEAL_SENSORS, NO_FRICTION
from planning_helpers import PERMITTED_FORCE, SMALL
from six_axis import SIX_AXIS, of_six

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.prediction import hold_at
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.drive import Drive
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

HOME, REST = np.array(SIX_AXIS.home), np.zeros(SIX_AXIS.n)
UPPER_ARM = 1
"""The second of the two capsules on link_2."""


def test_planner_leads_it_to_its_goal_and_predicts_contact_as_in_the_simulation(quick_compilation):
    planner = RecedingHorizonPlanner(SIX_AXIS, SMALL, ImpedanceSettings(), PERMITTED_FORCE, capacity=1)
    goal = Target(hold_at(SIX_AXIS, HOME).position + np.array([0.0, 0.1, 0.0]))
    plan = planner.plan(Request(HOME, REST, 0, 10_000_000, goal, Spheres.none()))
    assert plan.postures.shape == (SMALL.horizon, SIX_AXIS.n)
    distances = np.linalg.norm(plan.predicted_positions - goal.position, axis=1)
    assert distances[-1] < distances[0] - 0.005
    # A ball 10 mm deep in the upper arm, whose forces on the link's two capsules add up.
    starts, ends = capsule_segments(SIX_AXIS, HOME)
    settings = BallSettings(stiffness=5000.0, damping=500.0)
    reach = SIX_AXIS.capsules[UPPER_ARM].radius + settings.radius - 0.01
    balls = settings.at(0.5 * (starts + ends)[UPPER_ARM] + np.array([0.0, reach, 0.0]))
    scene = Scene("test", SIX_AXIS, 0, HOME, goal.position, balls)
    plant = Plant(scene, IDEAL_SENSORS, NO_FRICTION)
    for _ in range(30):
        plant.step()
    planner.reset()
    touching = planner.plan(
        Request(HOME, REST, 0, 10_000_000, goal, obstacle_spheres(scene, rest_positions(scene)))
    ).predicted_contact_forces
    assert touching.shape == (SMALL.horizon, len(SIX_AXIS.contact_links))
    assert np.flatnonzero(plant.contact_forces()).tolist() == np.flatnonzero(touching[0]).tolist() == [0]
    assert touching[0, 0] == pytest.approx(plant.contact_forces()[0], rel=0.15)


@pytest.mark.parametrize("name", ["free", "ball", "wall"])
def test_scenes_are_made_and_simulated(name):
    file = read_scene(name)
    if file.target.start is not None:
        with pytest.raises(SettingsError, match=r"start = .*: expected a list of 6 values"):
            make_scene(file, SIX_AXIS, 0)
        target = dataclasses.replace(file.target, start=of_six(file.target.start))
        file = dataclasses.replace(file, target=target)
    scene = make_scene(file, SIX_AXIS, 0)
    plant = Plant(scene, IDEAL_SENSORS, NO_FRICTION)
    assert plant.contact_links == SIX_AXIS.contact_links
    np.testing.assert_array_equal(plant.read().q, scene.start)
    with pytest.raises(InputError, match="7 values; expected 6"):
        Drive(plant, WatchdogSettings(), open_after=0.0).command(np.zeros(ARM.n), 0)
