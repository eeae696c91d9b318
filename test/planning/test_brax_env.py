"""The closed loop in Brax's own terms: what Brax rolls out is what the planner rolls out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM
from brax import envs

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.brax_env import NAME, ContactReach
from contact_reach_ros.planning.prediction import hold_at
from contact_reach_ros.planning.transfer.pipeline import Reference
from contact_reach_ros.scenes.generate import load_scene

pytestmark = pytest.mark.usefixtures("quick_compilation")

KNOTS = 4


@pytest.fixture(scope="module")
def env(quick_compilation) -> ContactReach:
    """The ball, beside the hand from the start."""
    scene = load_scene("ball", arm=ARM, seed=0)
    (ball,) = scene.obstacles
    tip = hold_at(ARM, scene.start).position
    near = dataclasses.replace(ball, rest=(tip - np.array([0.0, 0.13, 0.02]))[None])
    return ContactReach(dataclasses.replace(scene, obstacles=(near,)))


@pytest.mark.slow
def test_episode_is_the_rollout_of_the_planner(env):
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (KNOTS, env.action_size)).astype(np.float32)
    actions[:, 1] = -1.0
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    states = [state := step(state, action) for action in actions]
    hold = hold_at(ARM, np.asarray(env._problem.q, float)[:, 0])
    before = Reference(*(jnp.asarray(part, jnp.float32)[..., None] for part in hold))
    objective, problem = dataclasses.replace(env._space.objective, horizon=KNOTS), env._problem._replace(before=before)
    scaled = (actions * np.asarray(env._space.bounds))[..., None]

    def run(actions: jax.Array) -> tuple:
        rollout = objective.roll_out(problem, actions)
        return rollout, objective.terms(problem, actions, rollout)

    rollout, terms = jax.jit(run)(scaled)
    assert float(rollout.link_force.max()) > 1.0
    for knot, state in enumerate(states):
        pipeline_state = state.pipeline_state
        np.testing.assert_allclose(pipeline_state.q, rollout.q[knot + 1, :, 0], rtol=0, atol=2e-6)
        np.testing.assert_allclose(pipeline_state.link_force, rollout.link_force[knot], rtol=1e-4, atol=1e-3)
        # Brax's own kinematics.
        flange = hold_at(ARM, np.asarray(pipeline_state.q, float))
        last = pipeline_state.x.pos[-1] + flange.rotation @ np.array(ARM.tip_offset)
        np.testing.assert_allclose(last, flange.position, rtol=0, atol=1e-5)
    for name, value in terms.items():
        total = sum(float(state.metrics[name]) for state in states)
        np.testing.assert_allclose(total, float(value[0]), rtol=2e-5, atol=2e-6, err_msg=name)
    returned = sum(float(state.reward) for state in states)
    assert returned == pytest.approx(-sum(float(value[0]) for value in terms.values()), rel=1e-5)


def test_brax_knows_the_environment_and_another_system_is_refused(env):
    made = envs.get_environment(NAME, scene=load_scene("free", arm=ARM))
    assert isinstance(made, ContactReach) and made.action_size == 6 + ARM.n
    assert made.backend == NAME

    # As Brax's wrapper for randomised domains does it.
    made.sys = made.sys.tree_replace({"link.inertia.mass": 2.0 * made.sys.link.inertia.mass})
    with pytest.raises(SettingsError, match="domains cannot be randomised"):
        made.reset(jax.random.key(0))
