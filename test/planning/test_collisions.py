"""The planner keeps the arm clear of rigid bodies and of itself, and refuses plans that do not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, HOME, random_states

from contact_reach_ros.arm.capsules import pair_distances, self_pairs, shape_radii, shape_segments
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.obstacles import BLOCKS, PLANES, check_motion, nearest_bodies
from contact_reach_ros.planning.settings import ReplanningSettings
from contact_reach_ros.planning.terms import TERMS
from contact_reach_ros.planning.transfer.clearance import intrusions
from contact_reach_ros.planning.transfer.dynamics import link_frames, place_capsules
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
AT_BASE = np.array([-1.232, 1.536, 0.311, -1.789, -0.306, 1.494, 1.921])
"""The hand is low beside the base and points at it."""
BESIDE = (0.58, 0.25, 0.12)
"""Straight from home it is through the table's edge."""
BEYOND_BASE = (0.124, 0.157, 0.0)
"""Straight from `AT_BASE` it is through the base."""


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
        return sum(intrusions(arm, place_capsules(arm, link_frames(arm, q)), bodies, margin))

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


def test_a_motion_into_a_body_is_refused_with_numbers_and_one_out_of_it_is_not():
    floor = (Plane("floor", (0.0, 0.0, 0.22)),)
    up = np.linspace(HOME, HOME + np.array([0.0, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0]), 4)
    assert nearest(ARM, up[:1], floor)[0].distance < -0.01
    check_motion(ARM, up, floor)
    with pytest.raises(PlanningError, match=r"lbr_link_7 lies 1\d\.\d mm deep in the floor, expected 2 mm or more"):
        check_motion(ARM, up[::-1], floor)
    check_motion(ARM, up[::-1], (Plane("floor", (0.0, 0.0, 0.2)),))


TEN_A_SECOND = ReplanningSettings(period=0.1)


def stack_for(planner, environment: Environment, goal: Goal, start: np.ndarray = HOME) -> Stack:
    """A stack with the shared planner; its simulated robot has contact with rigid bodies and itself."""
    scene = Scene("test", ARM, 0, start, np.array(goal.position), environment=environment)
    return Stack(scene, planner=planner, replanning=TEN_A_SECOND)


@pytest.mark.parametrize(
    ("environment", "start", "goal", "largest"),
    [
        pytest.param((TABLE,), HOME, Goal(BESIDE), 0.02, marks=pytest.mark.slow, id="table"),
        pytest.param((), AT_BASE, Goal(BEYOND_BASE, FREE), 0.1, id="base"),
    ],
)
def test_the_arm_touches_neither_a_table_in_its_way_nor_itself(planner, environment, start, goal, largest):
    stack, postures = stack_for(planner, environment, goal, start), []
    result = stack.run(goal, 8.0, lambda _: postures.append(stack.robot.plant.data.qpos[: ARM.n].copy()))
    assert result.reached and result.max_contact_force == 0.0
    assert 0.005 < min(pair.distance for pair in nearest(ARM, np.array(postures), environment)) < largest


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_that_leads_into_a_body_is_refused_before_the_arm_touches_it(planner, monkeypatch, seed):
    """Of the shared planner, made to ignore bodies; its compiled programs are the same."""
    planner.reseed(seed)
    monkeypatch.setitem(TERMS, "clearance", TERMS["clearance"]._replace(weight=1e-6))
    goal = Goal(BESIDE)
    # Until a detour is due.
    result = stack_for(planner, (TABLE,), goal).run(goal, 1.1)
    assert not result.reached and result.max_contact_force == 0.0
    assert "the plan would bring the arm into a collision: lbr_link_7 " in result.stop_reason
    assert "the table, expected 2 mm or more between them" in result.stop_reason
