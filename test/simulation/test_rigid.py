"""The simulated arm touches floor, table and itself, and nothing else does."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME, NO_FRICTION, ideal_plant

from contact_reach_ros.simulation.plant import Actuation, Plant
from contact_reach_ros.world.collision import nearest
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.rigid import Block, Plane
from contact_reach_ros.world.scene import Scene

FLOOR = Plane("floor", (0.0, 0.0, 0.1))
TABLE = Block("table", (0.6, 0.0, 0.05), (0.4, 0.6, 0.1), (0.0, 0.0, 0.3826834, 0.9238795))
FOLDED = np.array([-0.111, -1.675, -2.867, -1.939, 2.733, -1.506, -2.731])
"""Hand and base overlap by 12 mm."""


def plant_among(*bodies, start: np.ndarray = HOME, obstacles=()) -> Plant:
    scene = Scene("test", ARM, 0, start, np.zeros(3), tuple(obstacles), environment=bodies)
    return Plant(scene, NO_FRICTION)


def least_distance(plant: Plant) -> float:
    return nearest(ARM, plant.data.qpos[None, : ARM.n], plant.scene.environment)[0].distance


@pytest.mark.parametrize("body", [FLOOR, TABLE], ids=["plane", "block"])
def test_an_arm_without_torque_falls_onto_a_rigid_body_and_stays_there(body):
    plant = plant_among(body)
    plant.set_actuation(Actuation.COMMANDED)
    touched, deepest = False, 0.0
    for step in range(800):
        plant.step(np.zeros(ARM.n))
        touched |= plant.contact_forces().max() > 0.0
        if step % 4 == 0:
            deepest = min(deepest, least_distance(plant))
    assert touched
    assert -5e-3 < deepest < 0.0
    free = ideal_plant()
    free.set_actuation(Actuation.COMMANDED)
    for _ in range(800):
        free.step(np.zeros(ARM.n))
    assert nearest(ARM, free.data.qpos[None, : ARM.n], (body,))[0].distance < -0.05


def test_the_arm_touches_itself_where_its_shapes_overlap():
    plant = plant_among(start=FOLDED)
    before = least_distance(plant)
    forces = plant.contact_forces()
    assert [ARM.contact_links[link] for link in np.flatnonzero(forces)] == ["lbr_link_7"]
    assert forces.max() > 10.0
    for _ in range(200):
        plant.step()
    assert before < -0.01 < 0.0 < least_distance(plant)


def test_soft_obstacles_and_the_base_may_lie_in_rigid_bodies():
    ball = BallSettings(radius=0.05).at(np.array([0.6, 0.2, 0.08]))
    plant = plant_among(dataclasses.replace(FLOOR, point=(0.0, 0.0, 0.02)), TABLE, obstacles=ball)
    for _ in range(50):
        plant.step()
    assert plant.data.ncon == 0
    np.testing.assert_allclose(plant.obstacle_positions(), ball[0].rest, atol=1e-6)
