"""The planner keeps the arm clear of rigid bodies and of itself, and refuses plans that do not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, HOME, random_states

from contact_reach_ros.arm.capsules import pair_distances, self_pairs, shape_radii, shape_segments
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning import obstacles
from contact_reach_ros.planning.obstacles import BLOCKS, PLANES, check_motion, nearest_bodies
from contact_reach_ros.planning.transfer.clearance import intrusion
from contact_reach_ros.planning.transfer.dynamics import link_frames, place_capsules
from contact_reach_ros.planning.transfer.lanes import make_keep
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.collision import body_distances, nearest
from contact_reach_ros.world.goal import FREE, Goal
from contact_reach_ros.world.rigid import Block, Environment, Plane
from contact_reach_ros.world.scene import Scene

TABLE = Block("table", (0.5, 0.0, 0.09), (0.3, 0.2, 0.18))
BODIES = (
    Plane("floor", (0.0, 0.0, 0.1)),
    Plane("wall", (0.7, 0.0, 0.0), (-1.0, 0.2, 0.1)),
    TABLE,
    Block("beam", (0.2, 0.5, 0.6), (0.1, 0.1, 1.0), (0.4, 0.1, 0.2, 0.8888)),
)
MARGIN = 0.3
"""Large, so that random postures are within it."""
FOLDED = np.array([-0.111, -1.675, -2.867, -1.939, 2.733, -1.506, -2.731])
"""Hand and base overlap by 12 mm."""


AT_BASE = np.array([-1.232, 1.536, 0.311, -1.789, -0.306, 1.494, 1.921])
"""The hand is low beside the base and points at it."""
LIFTED = HOME + np.array([0.0, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0])


def expected_intrusion(q: np.ndarray, environment: Environment, margin: float) -> np.ndarray:
    """Σ max(margin − distance, 0)² (N,) of postures (N, n), by the searches of `world.collision`."""
    starts, ends = shape_segments(ARM, q)
    distances = [pair_distances(ARM, q, np.array(self_pairs(ARM)))]
    for body in environment:
        apart = body_distances(body, starts[:, 1:], ends[:, 1:])
        # The program does not look how deep a capsule's axis is in a block.
        apart = np.maximum(apart, 0.0) if isinstance(body, Block) else apart
        distances.append(apart - shape_radii(ARM)[1:])
    short = np.maximum(margin - np.concatenate(distances, axis=1), 0.0)
    return (short**2).sum(axis=1)


@pytest.fixture(scope="module")
def program():
    arm = arm_model(ARM)

    def run(q, bodies, margin):
        keep = make_keep(q)
        return intrusion(arm, place_capsules(arm, link_frames(arm, q, keep)), bodies, margin, keep)

    return jax.jit(run)


def test_the_compiled_distances_are_those_of_the_searches(program):
    q = np.concatenate([random_states(300)[0], HOME + np.random.default_rng(1).normal(0.0, 0.3, (100, 7))])
    bodies = nearest_bodies(ARM, HOME, BODIES)
    found = program(jnp.asarray(q.T, jnp.float32), bodies, MARGIN)
    expected = expected_intrusion(q, BODIES, MARGIN)
    assert (expected > 0.0).mean() > 0.9
    off = np.abs(np.asarray(found) - expected) / np.maximum(expected, 1e-3)
    assert np.quantile(off, 0.99) < 1e-3
    assert off.max() < 0.05


def test_without_bodies_only_the_arm_itself_counts(program):
    q = np.stack([HOME, FOLDED])
    found = np.asarray(program(jnp.asarray(q.T, jnp.float32), nearest_bodies(ARM, HOME, ()), 0.02))
    np.testing.assert_allclose(found, expected_intrusion(q, (), 0.02), rtol=1e-2, atol=1e-9)
    assert found[0] == 0.0 < found[1]


def test_the_derivative_at_fixed_nearest_points_is_that_of_the_distance(program):
    bodies = nearest_bodies(ARM, HOME, BODIES)
    for seed in range(5):
        random = np.random.default_rng(seed)
        q, direction = HOME + random.normal(0.0, 0.2, 7), random.standard_normal(7)
        column = [jnp.asarray(values[:, None], jnp.float32) for values in (q, direction)]
        _, slope = jax.jvp(lambda angles: program(angles, bodies, MARGIN), column[:1], column[1:])
        step = 1e-4
        ends = np.stack([q - step * direction, q + step * direction])
        before, after = expected_intrusion(ends, BODIES, MARGIN)
        assert float(slope[0]) == pytest.approx((after - before) / (2.0 * step), rel=0.02, abs=1e-3)


def test_of_many_bodies_the_nearest_are_taken():
    far = [Plane(f"far {k}", (0.0, 0.0, -1.0 - k)) for k in range(PLANES)]
    beside = [Block(f"beside {k}", (2.0 + k, 0.0, 0.0), (0.1, 0.1, 0.1)) for k in range(BLOCKS)]
    bodies = nearest_bodies(ARM, HOME, (*far, *beside, BODIES[0], TABLE))
    assert 0.1 in np.round(bodies.offset, 6)
    assert TABLE.center[2] in np.round(bodies.center, 6)
    assert bodies.offset.shape == (PLANES, 1) and bodies.half.shape == (3, BLOCKS, 1)


class TestRefusal:
    def test_a_motion_into_a_body_is_refused_with_numbers_and_one_out_of_it_is_not(self):
        floor = (Plane("floor", (0.0, 0.0, 0.22)),)
        with pytest.raises(PlanningError, match=r"lbr_link_7 lies 1\d\.\d mm deep in the floor, permitted are 2 mm"):
            check_motion(ARM, np.stack([LIFTED, HOME]), floor)
        check_motion(ARM, np.stack([LIFTED, HOME]), (Plane("floor", (0.0, 0.0, 0.2)),))

        up = np.linspace(HOME, LIFTED, 4)
        assert nearest(ARM, up[:1], floor)[0].distance < -0.01
        check_motion(ARM, up, floor)
        with pytest.raises(PlanningError):
            check_motion(ARM, up[::-1], floor)


class Watched:
    """A stack with the shared planner, and how near the true arm came to bodies and itself."""

    def __init__(self, core, environment: Environment, target, start: np.ndarray = HOME) -> None:
        scene = Scene("test", ARM, 0, start, np.array(target), environment=environment)
        self.stack = Stack(scene, planner=core)
        self.least = np.inf

    def run(self, goal: Goal, timeout: float):
        return self.stack.run(goal, timeout, self.look)

    def look(self, _) -> None:
        q = self.stack.robot.plant.data.qpos[None, : ARM.n]
        self.least = min(self.least, nearest(ARM, q, self.stack.scene.environment)[0].distance)


@pytest.fixture
def careless(planner, monkeypatch):
    """The shared planner, made to ignore bodies; its compiled programs are the same."""
    monkeypatch.setattr(planner, "_settings", dataclasses.replace(planner._settings, clearance_weight=1e-6))
    monkeypatch.setattr(obstacles, "COLLISION_TOLERANCE", 1.0)
    return planner


class TestClosedLoop:
    """Shapes and all are those of the simulated robot, which has contact with rigid bodies and itself."""

    BESIDE = (0.58, 0.25, 0.12)
    """Straight from home it is through the table's edge."""
    BEYOND_BASE = (0.124, 0.157, 0.0)
    """Straight from `AT_BASE` it is through the base."""

    @pytest.mark.slow
    def test_past_the_edge_of_a_table_the_arm_does_not_touch_it(self, planner):
        watched = Watched(planner, (TABLE,), self.BESIDE)
        result = watched.run(Goal(self.BESIDE), 8.0)
        assert result.reached and result.max_contact_force == 0.0
        assert 0.005 < watched.least < 0.02

    def test_its_plans_are_refused_before_that(self, careless, monkeypatch):
        monkeypatch.setattr(obstacles, "COLLISION_TOLERANCE", 0.002)
        watched = Watched(careless, (TABLE,), self.BESIDE)
        result = watched.run(Goal(self.BESIDE), 3.0)
        assert not result.reached and result.max_contact_force == 0.0
        assert "the plan would bring the arm into a collision: lbr_link_7 lies" in result.stop_reason
        assert "deep in the table, permitted are 2 mm" in result.stop_reason

    def test_around_its_own_base_the_arm_does_not_touch_itself(self, planner):
        watched = Watched(planner, (), self.BEYOND_BASE, AT_BASE)
        result = watched.run(Goal(self.BEYOND_BASE, FREE), 8.0)
        assert result.reached and result.max_contact_force == 0.0
        assert watched.least > 0.005
