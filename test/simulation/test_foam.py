"""Walls in the simulation: they stay where they are, give way as the planner's model says, and push back."""

import dataclasses
import functools

import numpy as np
import pytest
from arm_simulation import ARM, HOME

from benchmarks.press import lattice, press_in_model, press_in_plant, stiffness_matrix
from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.obstacles import Foam
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.obstacle import WallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import check_stable, read_scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

FOREARM = 3
PRESS = 10.0


@functools.cache
def wall_scene() -> Scene:
    return make_scene(read_scene("wall"), ARM, 0)


def braked(scene: Scene) -> Plant:
    return Plant(scene)


def scene_beside_the_forearm(depth: float, **changes) -> Scene:
    """Coarse walls, held so that one node at the edge of the gap lies `depth` m deep in the forearm at home."""
    settings = WallSettings(size=(0.5, 1.0, 0.5), nodes=(2, 3, 2), gap=1.0, **changes)
    lower, upper = settings.at(np.zeros(3))
    starts, ends = capsule_segments(ARM, HOME)
    middle = (starts[FOREARM] + ends[FOREARM]) / 2
    # The end of the lower wall, from the left.
    end = np.flatnonzero(np.isclose(lower.rest[:, 1], lower.rest[:, 1].min()))
    touching = end[lower.rest[end, 2].argmax()]
    place = middle + np.array([0.0, 0.08 + settings.node_radius - depth, 0.0]) - lower.rest[touching]
    moved = tuple(dataclasses.replace(wall, rest=wall.rest + place) for wall in (lower, upper))
    return Scene("test", ARM, 0, HOME, np.zeros(3), tuple(moved))


def node_at(scene: Scene, wall: int, x: int, y: int, z: int) -> int:
    """Number of a node by its place in the lattice."""
    shape = lattice(scene.obstacles[wall])
    return wall * int(np.prod(shape)) + int(np.ravel_multi_index((x, y, z), shape))


def test_a_link_that_presses_is_pushed_back_with_what_the_springs_pull():
    scene = scene_beside_the_forearm(0.03)
    plant = braked(scene)
    for _ in range(2000):
        plant.step()
    displaced = plant.obstacle_positions() - rest_positions(scene)
    fixed = np.concatenate([wall.fixed for wall in scene.obstacles])
    assert not displaced[fixed].any()
    # At rest the force of contact is what holds all the nodes against their springs.
    free = plant.data.qpos[7:]
    springs = -Foam(scene.obstacles).forces(free).reshape(-1, 3)
    forces = plant.contact_forces()
    assert forces.max() > 0.5
    assert forces.max() == pytest.approx(np.linalg.norm(springs.sum(axis=0)), rel=0.02)
    assert ARM.contact_links[int(forces.argmax())] == "lbr_link_5"


@pytest.mark.parametrize(
    ("node", "direction"),
    [
        ((1, 0, 5, 0), (1.0, 0.0, 0.0)),  # upper wall: middle of the lower edge, front
        ((1, 0, 0, 0), (0.0, 0.6, 0.8)),  # corner
        ((0, 1, 10, 1), (1.0, 0.0, 0.0)),  # lower wall, back, next to the fixed row
    ],
)
def test_a_pressed_node_gives_way_as_the_planner_thinks(node, direction):
    scene = wall_scene()
    number, force = node_at(scene, *node), PRESS * np.array(direction)
    track = press_in_plant(braked(scene), number, force, 800) @ direction
    times = 1e-3 * np.arange(1, 801)
    spheres = obstacle_spheres(scene, rest_positions(scene))
    model = press_in_model(spheres, number, force, times) @ direction
    assert track[-1] > 0.02
    assert track[-1] == pytest.approx(model[-1], rel=0.2)
    settled = press_in_model(spheres, number, force, np.array([np.inf]))[0]
    np.testing.assert_allclose(
        settled, np.linalg.inv(stiffness_matrix(spheres))[number, number] * force, rtol=1e-6, atol=1e-12
    )
    # Time until 63 % of the way.
    constants = [1e-3 * (1 + np.searchsorted(way, 0.632 * way[-1])) for way in (track, model)]
    assert constants[0] == pytest.approx(constants[1], rel=0.3)


class TestFoam:
    def scene(self, **changes) -> Scene:
        return Scene("test", ARM, 0, HOME, np.zeros(3), WallSettings(**changes).at(np.zeros(3)))

    def test_large_ones_are_answered_more_stiffly_by_the_hardening(self):
        material = WallSettings().at(np.zeros(3))[0].material
        soft, hard = (
            Foam([dataclasses.replace(wall, material=changed) for wall in self.scene().obstacles])
            for changed in (dataclasses.replace(material, hardening=h) for h in (0.0, 0.5))
        )
        # One end node of the lower wall, whose three springs are 0.05, 0.095 and 0.075 m long.
        settings = WallSettings()
        moved = np.zeros((2 * 44, 3))
        corner = np.flatnonzero(np.arange(66) % 3 > 0).tolist().index(2)
        moved[corner] = (0.0, 0.05, 0.0)
        lengths = np.array([0.05, 0.095, 0.075])
        nominal = 3 * settings.edge_stiffness * 0.05
        stiffer = settings.edge_stiffness * 0.05 * (1 + 0.5 * (0.05 / lengths) ** 2).sum()
        assert soft.forces(moved.ravel()).reshape(-1, 3)[corner, 1] == pytest.approx(-nominal)
        assert hard.forces(moved.ravel()).reshape(-1, 3)[corner, 1] == pytest.approx(-stiffer)


def test_the_stiffest_mesh_that_is_accepted_comes_to_rest():
    """Half of what semi-implicit Euler steps hold, so that there is room for hardening."""
    scene = wall_scene()
    settings = WallSettings(edge_stiffness=1900.0, node_mass=0.01, damping=0.1)
    walls = settings.at(np.array([0.55, 0.0, 0.4]))
    with pytest.raises(SceneError, match="use softer foam or more mass"):
        check_stable(dataclasses.replace(settings, edge_stiffness=1901.0).at(np.zeros(3))[0])
    scene = dataclasses.replace(scene, obstacles=walls)
    track = press_in_plant(braked(scene), node_at(scene, 1, 0, 5, 0), np.array([3 * PRESS, 0.0, 0.0]), 3000)[:, 0]
    settled = press_in_model(
        obstacle_spheres(scene, rest_positions(scene)),
        node_at(scene, 1, 0, 5, 0),
        np.array([3 * PRESS, 0.0, 0.0]),
        np.array([np.inf]),
    )[0, 0]
    assert np.abs(track).max() < 3 * settled
    assert track[-500:].mean() == pytest.approx(settled, rel=0.1)
