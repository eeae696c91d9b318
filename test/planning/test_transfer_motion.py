"""The transfer model against MuJoCo at 1 ms, with the controller's own law computing the torques."""

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import FAR_BALL, LANES, ball, make_problem, simulate

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.settings import ImpedanceSettings

BOUNDS = np.array([0.01] * 3 + [0.1] * 3 + [0.2] * 7)
SIMULATED = 20
"""Lanes that MuJoCo simulates, too."""


def test_the_flange_is_predicted_within_a_millimetre_and_half_a_degree(roll_out):
    """From random states, under random actions."""
    random, model = np.random.default_rng(0), RobotModel(ARM)
    starts = HOME[:, None] + random.uniform(-0.4, 0.4, (7, LANES))
    actions = random.uniform(-1.0, 1.0, (3, 13, LANES)) * BOUNDS[None, :, None]
    rollout, _ = roll_out(make_problem(starts, np.zeros(3), ball(FAR_BALL)), actions)
    errors = []
    for lane in range(SIMULATED):
        angles = simulate(ARM, ImpedanceSettings(), starts[:, lane], actions[:, :, lane])
        for knot, (position, rotation) in enumerate(map(model.tip_pose, angles), start=1):
            turn = np.asarray(rollout.pose.rotation[knot, :, :, lane], float) @ rotation.T
            errors.append(np.linalg.norm([rollout.pose.position[knot, :, lane] - position, pin.log3(turn)], axis=1))
    offsets, angles = np.transpose(errors)
    assert offsets.max() < 1e-3 and offsets.mean() < 2e-4
    assert angles.max() < np.radians(0.5)


@pytest.mark.parametrize(
    "pose",
    [np.zeros(7), HOME * (1, 1, 1, 1, 1, 0, 1), HOME * (1, 1, 1, 0, 1, 1, 1)],
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
    # What the arm could not do costs.
    fastest = (moved / 0.1 / np.array(ARM.velocity_limits)[:, None]).max(axis=(0, 1))
    assert ((fastest > 1.0) == (np.asarray(terms["joint_speed"]) > 0.0)).all()
    assert (fastest > 1.0).any()
