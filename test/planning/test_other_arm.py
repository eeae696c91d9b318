"""An arm with another number of joints, asymmetric limits and other capsules: nothing here is about the iiwa alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, IDEAL_SENSORS, NO_FRICTION
from planning_helpers import PERMITTED_FORCE, SMALL
from six_axis import SIX_AXIS, of_six

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.planning import cost
from contact_reach_ros.planning.obstacles import ObstacleReader, clearances
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.prediction import hold_at
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.drive import Drive
from contact_reach_ros.simulation.plant import Actuation, Plant
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import BallSettings, Obstacle
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

pytestmark = pytest.mark.usefixtures("quick_compilation")

HOME, REST = np.array(SIX_AXIS.home), np.zeros(SIX_AXIS.n)
UPPER_ARM = 1
"""The second of the two capsules on link_2."""


@pytest.fixture(scope="module")
def planner(quick_compilation) -> RecedingHorizonPlanner:
    return RecedingHorizonPlanner(SIX_AXIS, SMALL, ImpedanceSettings(), PERMITTED_FORCE, capacity=1)


def ball_in_the_upper_arm(depth: float) -> Obstacle:
    starts, ends = capsule_segments(SIX_AXIS, HOME)
    settings = BallSettings(stiffness=5000.0, damping=500.0)
    reach = SIX_AXIS.capsules[UPPER_ARM].radius + settings.radius - depth
    (ball,) = settings.at(0.5 * (starts + ends)[UPPER_ARM] + np.array([0.0, reach, 0.0]))
    return ball


def test_forces_of_the_capsules_on_a_link_add_up_as_in_the_simulation():
    scene = Scene("test", SIX_AXIS, 0, HOME, np.zeros(3), (ball_in_the_upper_arm(0.01),))
    plant = Plant(scene, IDEAL_SENSORS, NO_FRICTION)
    for _ in range(30):
        plant.step()
    spheres = obstacle_spheres(scene, rest_positions(scene))
    obstacles, _ = ObstacleReader(SIX_AXIS, 1).read(HOME, spheres)
    system = cost.make_objective(SIX_AXIS, SMALL, ImpedanceSettings()).system
    hold = hold_at(SIX_AXIS, HOME)
    reference = pipeline.Reference(*(jnp.asarray(part)[..., None] for part in hold))
    state = pipeline.init(system, jnp.asarray(HOME)[:, None], jnp.asarray(REST)[:, None], obstacles)
    state = jax.jit(lambda state: pipeline.step(system, state, reference))(state)
    assert state.link_force.shape == (len(SIX_AXIS.contact_links), 1)
    force = plant.contact_forces()
    assert np.flatnonzero(force).tolist() == np.flatnonzero(state.link_force[:, 0]).tolist() == [0]
    assert float(state.link_force[0, 0]) == pytest.approx(force[0], rel=0.15)


def test_planner_leads_it_to_its_goal_and_away_from_a_ball(planner):
    flange = hold_at(SIX_AXIS, HOME).position
    goal = Target(flange + np.array([0.0, 0.1, 0.0]))
    planner.reset()
    plan = planner.plan(Request(HOME, REST, 0, 10_000_000, goal, Spheres.none()))
    assert plan.postures.shape == (SMALL.horizon, SIX_AXIS.n)
    assert plan.predicted_contact_forces.shape == (SMALL.horizon, len(SIX_AXIS.contact_links))
    distances = np.linalg.norm(plan.predicted_positions - goal.position, axis=1)
    assert distances[-1] < distances[0] - 0.005
    ball = ball_in_the_upper_arm(0.01)
    scene = Scene("test", SIX_AXIS, 0, HOME, goal.position, (ball,))
    spheres = obstacle_spheres(scene, rest_positions(scene))
    assert clearances(SIX_AXIS, HOME, spheres)[0] == pytest.approx(-0.01, abs=1e-6)
    planner.reset()
    touching = planner.plan(Request(HOME, REST, 0, 10_000_000, goal, spheres))
    assert touching.predicted_contact_forces[0, 0] > 0.0
    np.testing.assert_array_equal(touching.predicted_contact_forces[:, 1:], 0.0)


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
    drive = Drive(plant, WatchdogSettings(), open_after=0.0)
    with pytest.raises(InputError, match="7 values; expected 6"):
        drive.command(np.zeros(ARM.n), 0)
    model = RobotModel(SIX_AXIS)
    for tick in range(50):
        model.update(plant.read().q, plant.read().v)
        drive.command(model.bias.copy(), tick * 1_000_000)
        drive.tick(tick * 1_000_000)
    assert plant.actuation is Actuation.COMMANDED and not drive.stop_reason
    np.testing.assert_allclose(plant.read().q, scene.start, rtol=0, atol=1e-3)
    assert plant.contact_forces().shape == (len(SIX_AXIS.contact_links),)
