"""Contact of the transfer model: directions, energy and equilibrium."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import ball, ball_at, beside_forearm, obstacles_of

from contact_reach_ros.arm import link_frames as table_frames
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.contact import CONTACT_STIFFNESS, Contact, Obstacles, contact_step, response
from contact_reach_ros.planning.transfer.dynamics import link_frames
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.planning.unexpected_contact import NEAR, places_near
from contact_reach_ros.world.collision import clearances
from contact_reach_ros.world.spheres import Spheres

pytestmark = pytest.mark.usefixtures("quick_compilation")

AN_INSTANT = 1e-6
"""A step in which no sphere gives way, s."""

FOREARM = 3
"""Place of link 5 among the capsules."""


@pytest.fixture(scope="module")
def touch():
    @jax.jit
    def run(q: jax.Array, obstacles: Obstacles) -> Contact:
        frames = link_frames(arm_model(ARM), q)
        return contact_step(arm_model(ARM), frames, obstacles, AN_INSTANT)

    return lambda q, obstacles: jax.tree.map(np.asarray, run(jnp.asarray(q)[:, None], obstacles))


def test_force_is_stiffness_times_depth_on_the_touched_link_alone(touch):
    contact = touch(HOME, ball(beside_forearm(-0.005)))
    assert contact.link_force[FOREARM, 0] == pytest.approx(5.0, rel=1e-3)
    assert np.delete(contact.link_force, FOREARM).max() == 0.0


def test_a_ball_that_yields_presses_no_link_that_is_not_near_it():
    frames, random, pressed = link_frames(arm_model(ARM), jnp.asarray(HOME)[:, None]), np.random.default_rng(1), 0
    run = jax.jit(lambda obstacles: contact_step(arm_model(ARM), frames, obstacles, 0.025).link_force[:, 0])
    while pressed < 100:
        center = table_frames(ARM, HOME)[1][random.integers(2, 6)] + random.normal(scale=0.15, size=3)
        # It yields by less than a link enters it.
        if -NEAR < clearances(ARM, HOME, ball_at(center))[0] < 0.0:
            near, forces = places_near(ARM, HOME, ball_at(center))[0], np.asarray(run(ball(center, 60.0)))
            pressed += 1
            assert not np.delete(forces, near - 1).any()


def test_joint_torque_is_the_derivative_of_the_contact_energy(touch):
    center = beside_forearm(-0.01)

    def energy(q: np.ndarray) -> float:
        return 0.5 * CONTACT_STIFFNESS * min(clearances(ARM, q, ball_at(center))[0], 0.0) ** 2

    step = 1e-5
    expected = [-(energy(HOME + step * axis) - energy(HOME - step * axis)) / (2 * step) for axis in np.eye(7)]
    np.testing.assert_allclose(touch(HOME, ball(center)).joint_torque[:, 0], expected, rtol=0, atol=0.01)


def test_capsules_that_touch_one_sphere_share_its_force_as_it_yields_to_all_of_them():
    """Against forces that fit the depths that they leave, wherever a soft ball touches two capsules or more."""
    frames, random, time = link_frames(arm_model(ARM), jnp.asarray(HOME)[:, None]), np.random.default_rng(0), 0.025
    run = jax.jit(lambda obstacles: contact_step(arm_model(ARM), frames, obstacles, time).link_force)
    # At the instant at which contact is evaluated.
    yielding = float(response(ball(HOME[:3], 60.0), 0.7 * time)[1][0, 0])
    radii, errors = np.array([capsule.radius for capsule in ARM.capsules]), []
    while len(errors) < 200:
        center = table_frames(ARM, HOME)[1][random.integers(2, 6)] + random.normal(scale=0.15, size=3)
        links, points, normals = places_near(ARM, HOME, ball_at(center))
        depths = radii[links - 1] + 0.1 - np.linalg.norm(points - center, axis=1)
        if (depths > 0.002).sum() < 2 or depths.max() > 0.03:
            continue
        force = np.zeros(len(depths))
        for _ in range(200):
            left = depths - yielding * normals @ (force @ normals)
            force += 0.2 * (CONTACT_STIFFNESS * np.maximum(left, 0.0) - force)
        errors.append(np.abs(np.asarray(run(ball(center, 60.0)))[links - 1, 0] - force).max() / force.max())
    assert np.median(errors) < 0.01
    assert max(errors) < 0.1


@pytest.fixture(scope="module")
def settled(objective):
    """What the arm comes to when it is told to stay at home, and obstacles are in its way."""
    system = objective.system

    @jax.jit
    def settle(q: jax.Array, obstacles: Obstacles) -> pipeline.State:
        state = pipeline.init(system, q, jnp.zeros_like(q), obstacles)
        held = pipeline.Reference(*pipeline.tip_pose(system, state.q), state.q)
        return jax.lax.fori_loop(0, 400, lambda _, state: pipeline.step(system, state, held), state)

    return lambda obstacles: settle(jnp.asarray(HOME)[:, None], obstacles)


@pytest.mark.parametrize(("stiffness", "damping"), [(100.0, 30.0), (5000.0, 1.0)])
def test_ball_that_is_pushed_comes_to_rest_where_its_spring_holds_the_force(settled, stiffness, damping):
    """A stiff anchor with hardly any damping too: no step is too long for the ball."""
    obstacles = ball(beside_forearm(-0.02), stiffness, damping)
    state = settled(obstacles)
    assert np.abs(np.asarray(state.qd)).max() < 1e-3
    displacement = np.asarray(state.obstacles.center - state.obstacles.rest)[:, 0, 0]
    force = float(state.link_force.max())
    assert force > 0.5
    assert stiffness * np.linalg.norm(displacement) == pytest.approx(force, rel=0.01)
    assert displacement[1] > 0.0


def chain(count: int) -> Spheres:
    """Small spheres in a row along the forearm, 4 mm deep in it, the ends anchored, neighbours joined."""
    along = np.linspace(0.06, 0.16, count)
    center = np.array([beside_forearm(-0.004)] * count)
    rotation = table_frames(ARM, HOME)[0][4]
    center += (along - 0.11)[:, None] * rotation[:, 2] - np.array([0.0, 0.07, 0.0])
    anchors = np.zeros(count)
    anchors[[0, -1]] = 300.0
    edges = np.column_stack([np.arange(count - 1), np.arange(1, count)])
    return Spheres(center, center, np.full(count, 0.03), anchors, np.full(count, 5.0), edges, np.full(count - 1, 400.0))


def stiffness_of(spheres: Spheres) -> np.ndarray:
    """L, summed up edge by edge."""
    matrix = np.diag(spheres.stiffness)
    for (first, second), stiffness in zip(spheres.edges, spheres.edge_stiffness, strict=True):
        difference = np.eye(len(spheres))[first] - np.eye(len(spheres))[second]
        matrix = matrix + stiffness * np.outer(difference, difference)
    return matrix


def test_network_of_springs_and_dampers_is_followed_exactly():
    """Against many small steps of D u̇ = f − L u."""
    spheres, time, steps = chain(5), 0.025, 20000
    relaxation, compliance = jax.tree.map(np.asarray, response(obstacles_of(spheres), time))
    random = np.random.default_rng(0)
    start, force = random.uniform(-0.01, 0.01, 5), random.uniform(-5.0, 5.0, 5)
    displacement = start.copy()
    for _ in range(steps):
        displacement += time / steps * (force - stiffness_of(spheres) @ displacement) / spheres.damping
    np.testing.assert_allclose(relaxation @ start + compliance @ force, displacement, rtol=0, atol=2e-6)


@pytest.mark.parametrize("capacity", [pytest.param(5, marks=pytest.mark.slow), 2])
def test_joined_spheres_rest_where_their_springs_hold_the_force(settled, capacity):
    """With all spheres, and with two of them while the others are condensed away."""
    spheres = chain(5)
    obstacles = obstacles_of(spheres, capacity)
    state = settled(obstacles)
    displacement = np.asarray(state.obstacles.center - state.obstacles.rest)[:, :, 0]
    kept = [int(np.abs(spheres.rest - rest).sum(axis=1).argmin()) for rest in np.asarray(obstacles.rest)[:, :, 0].T]
    compliance = np.linalg.inv(stiffness_of(spheres))[np.ix_(kept, kept)]
    forces = np.linalg.solve(compliance, displacement.T)
    assert np.linalg.norm(forces, axis=1).sum() == pytest.approx(float(state.link_force.sum()), rel=0.02)
    assert np.linalg.norm(forces, axis=1).max() > 0.3
