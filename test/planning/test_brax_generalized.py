"""Brax's own pipeline as the transfer function."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import SMALL, make_problem

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.cost import knot_bounds, make_objective
from contact_reach_ros.planning.settings import PIPELINES, ReplanningSettings
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.stack import Stack, make_planner
from contact_reach_ros.world.goal import Goal


@pytest.mark.slow
def test_it_moves_the_arm_as_the_closed_loop_does():
    """In free space and from motion, within a tenth of the way that the tip goes."""
    random = np.random.default_rng(1)
    bounds = knot_bounds(ARM, SMALL)
    # Always ahead, so that the arm goes somewhere; turns and elbow at random.
    share = random.uniform(-0.4, 0.4, (SMALL.horizon, len(bounds), 4)).astype(np.float32)
    share[:, :3] = np.array([[1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, 1.0], [1.0, 1.0, -1.0, 1.0]])
    problem = make_problem(HOME, HOME[:3], None)._replace(v=jnp.asarray(random.uniform(-0.2, 0.2, (7, 1))))
    actions = share * bounds[None, :, None]
    rollouts = [
        # To compile takes nearly all of the time.
        jax.jit(objective.roll_out, compiler_options={"xla_backend_optimization_level": 0})(problem, actions)
        for objective in (
            make_objective(ARM, dataclasses.replace(SMALL, pipeline=name), ImpedanceSettings()) for name in PIPELINES
        )
    ]
    ours, theirs = (np.asarray(rollout.pose.position) for rollout in rollouts)
    way = np.linalg.norm(np.diff(ours, axis=0), axis=1).sum(axis=0)
    assert way.min() > 0.02
    assert np.all(np.linalg.norm(theirs - ours, axis=1) < 0.1 * way), np.linalg.norm(theirs - ours, axis=1)
    assert np.abs(np.asarray(rollouts[1].q - rollouts[0].q)).max() < np.radians(2.0)


@pytest.mark.slow
def test_generalized_pipeline_makes_whole_plans_that_lead_around_the_ball():
    """In lockstep, with a small budget: ten plans a second of three solver steps with 32 candidates each."""
    planning = dataclasses.replace(SMALL, pipeline="generalized", max_steps=3)
    scene = load_scene("ball", arm=ARM, seed=0)
    planner = make_planner(ARM, 1, planning=planning, replanning=ReplanningSettings(period=0.1))
    result = Stack(scene, planner=planner).run(Goal(scene.target), timeout=8.0)
    assert result.reached, result
    assert result.max_contact_force < load_budget().permitted_force
    assert result.plans > 30
