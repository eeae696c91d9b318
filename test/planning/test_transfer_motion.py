"""The transfer model against MuJoCo at 1 ms, with the controller's own law computing the torques."""

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import FAR_BALL, LANES, ball, make_problem

from benchmarks.model import simulate
from contact_reach_ros.world.scene import Scene

BOUNDS = np.array([0.01] * 3 + [0.1] * 3 + [0.2] * 7)
SIMULATED = 6
"""Lanes that MuJoCo simulates, too."""


ELBOW = HOME * (1, 1, 1, 0, 1, 1, 1)
"""A straight elbow."""


@pytest.mark.parametrize("pose, spread", [(HOME, 0.4), (ELBOW, 0.02)], ids=["anywhere", "elbow"])
def test_the_flange_is_predicted_within_a_millimetre_and_half_a_degree(roll_out, pose, spread):
    """From random states, under random actions that the controller's caps on force and speed let pass."""
    random = np.random.default_rng(0)
    starts = pose[:, None] + random.uniform(-spread, spread, (7, LANES))
    actions = random.uniform(-0.4, 0.4, (3, 13, LANES)) * BOUNDS[None, :, None]
    rollout, _ = roll_out(make_problem(starts, np.zeros(3), ball(FAR_BALL)), actions)
    errors = []
    for lane in range(SIMULATED):
        found = simulate(Scene("free", ARM, 0, starts[:, lane], np.zeros(3)), REST, actions[:, :, lane])
        for knot, (position, rotation) in enumerate(zip(found.positions, found.rotations, strict=True), start=1):
            turn = np.asarray(rollout.pose.rotation[knot, :, :, lane], float) @ rotation.T
            errors.append(np.linalg.norm([rollout.pose.position[knot, :, lane] - position, pin.log3(turn)], axis=1))
    offsets, angles = np.transpose(errors)
    assert offsets.max() < 1e-3 and offsets.mean() < 2e-4
    assert angles.max() < np.radians(0.5)


@pytest.mark.parametrize(
    "pose",
    [np.zeros(7), HOME * (1, 1, 1, 1, 1, 0, 1), ELBOW],
    ids=["straight", "wrist", "elbow"],
)
def test_motion_stays_bounded_at_a_singularity(roll_out, pose):
    random = np.random.default_rng(1)
    starts = pose[:, None] + random.uniform(-0.02, 0.02, (7, LANES))
    actions = random.choice([-1.0, 1.0], (3, 13, LANES)) * (BOUNDS * (1, 1, 1, 2, 2, 2, *[1] * 7))[None, :, None]
    rollout, terms = roll_out(make_problem(starts, np.zeros(3), ball(FAR_BALL)), actions)
    moved = np.abs(np.diff(np.asarray(rollout.q), axis=0))
    assert moved.max() <= 1.0 + 1e-5
    assert all(np.isfinite(term).all() for term in terms.values())
