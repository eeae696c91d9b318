"""Contact between the arm and a ball."""

import dataclasses

import mujoco
import numpy as np
import pytest
from arm_simulation import ARM, HOME

from benchmarks.faulty_robot import FaultyPlant
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.obstacle import BallSettings, Obstacle
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import rest_positions

ELBOW = 4
FOREARM = 5


def capsule_of(link: int) -> int:
    return [capsule.link for capsule in ARM.capsules].index(link)


def ball_beside(link: int, gap: float, **settings) -> Obstacle:
    """A ball to the left of the middle of a link at home, `gap` m away; below zero it overlaps."""
    kind = BallSettings(**settings)
    index = capsule_of(link)
    starts, ends = capsule_segments(ARM, HOME)
    distance = ARM.capsules[index].radius + kind.radius + gap
    (ball,) = kind.at((starts[index] + ends[index]) / 2 + np.array([0.0, distance, 0.0]))
    return ball


def braked(*balls: Obstacle, scale: float = 1.0) -> FaultyPlant:
    scene = Scene("test", ARM, 0, HOME, np.zeros(3), tuple(balls), foam_scale=scale)
    return FaultyPlant(scene)


def settle(plant: Plant, seconds: float = 2.0) -> None:
    for _ in range(round(1000 * seconds)):
        plant.step()


@pytest.mark.parametrize(("link", "mass"), [(ELBOW, 0.02), (7, 0.5)])
def test_fixed_nodes_are_as_stiff_as_declared_at_any_link(link, mass):
    def stiffness() -> float:
        settle(plant, 0.5)
        return plant.contact_forces().sum() / -plant.data.contact.dist.sum()

    ball = ball_beside(link, -0.01, contact_stiffness=1500.0, mass=mass)
    plant = braked(dataclasses.replace(ball, fixed=np.array([True])))
    assert stiffness() == pytest.approx(1500.0, rel=0.01)
    plant.set_payload(2.0)
    assert stiffness() == pytest.approx(1500.0, rel=0.01)


@pytest.mark.parametrize(
    ("contact_stiffness", "mass", "friction", "scale"),
    [(300.0, 0.1, 0.2, 1.3), (1000.0, 0.5, 0.0, 0.7), (10_000.0, 0.1, 1.0, 1.0)],
)
def test_a_ball_at_rest_is_as_stiff_as_declared_whatever_friction_and_mass(contact_stiffness, mass, friction, scale):
    material = {"contact_stiffness": contact_stiffness, "mass": mass, "friction": friction, "stiffness": 200.0}
    plant = braked(ball_beside(FOREARM, -0.02, **material), scale=scale)
    settle(plant)
    forces = plant.contact_forces()
    assert ARM.contact_links[int(np.flatnonzero(forces).item())] == ARM.link_names[FOREARM - 1]
    (contact,), (ball,) = plant.data.contact, plant.scene.obstacles
    assert forces.max() / -contact.dist == pytest.approx(scale * contact_stiffness, rel=0.06)
    moved = np.linalg.norm(plant.obstacle_positions()[0] - ball.rest[0])
    assert forces.max() == pytest.approx(scale * 200.0 * moved, rel=0.01)


def test_forces_are_those_that_mujoco_tells_of_each_contact():
    """On two links, with and without friction, while the contacts still slip."""
    left, elbow = ball_beside(FOREARM, -0.02, friction=0.5), ball_beside(ELBOW, -0.01, friction=1.0)
    smooth = ball_beside(FOREARM, -0.02, friction=0.0)
    plant = braked(left, elbow, dataclasses.replace(smooth, rest=smooth.rest * (1, -1, 1)))
    slipped = 0.0
    for _ in range(100):
        plant.step()
        total = np.zeros((len(ARM.contact_links), 3))
        for index, contact in enumerate(plant.data.contact):
            force = np.zeros(6)
            mujoco.mj_contactForce(plant.model, plant.data, index, force)
            names = [plant.model.body(plant.model.geom_bodyid[geom]).name for geom in contact.geom]
            (touched,) = (ARM.contact_links.index(name) for name in names if name in ARM.contact_links)
            total[touched] += force[:3] @ contact.frame.reshape(3, 3)
            slipped = max(slipped, float(np.linalg.norm(force[1:3])))
        np.testing.assert_allclose(plant.contact_forces(), np.linalg.norm(total, axis=1), rtol=0, atol=1e-9)
    assert sorted(plant.data.contact.dim.tolist()) == [1, 3, 3]
    assert slipped > 0.1


def test_balls_do_not_fall_and_do_not_touch_each_other():
    ball = ball_beside(ELBOW, 0.3)
    plant = braked(ball, dataclasses.replace(ball, rest=ball.rest + np.array([0.05, 0.0, 0.0])))
    settle(plant, 0.5)
    np.testing.assert_allclose(plant.obstacle_positions(), rest_positions(plant.scene), rtol=0, atol=1e-9)
