"""The transfer model against MuJoCo at 1 ms, with the controller's own law computing the torques."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import FAR_BALL, LANES, ball, make_problem

from benchmarks.law import ImpedanceLaw, pose_error
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.controller import blend
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings

TICKS_PER_KNOT = 100
BOUNDS = np.array([0.01] * 3 + [0.1] * 3 + [0.2] * 7)


def simulate(q: np.ndarray, actions: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Flange poses after each knot of the actions (H, 13), latched as the controller latches them."""
    plant = mujoco.MjModel.from_xml_string(build_mjcf(ARM))
    data = mujoco.MjData(plant)
    data.qpos[:] = q
    gains = ImpedanceSettings()
    law, model = ImpedanceLaw(ARM, gains), RobotModel(ARM)
    poses = []
    before = Reference(*model.tip_pose(q), q)
    for action in actions:
        ahead = data.qpos + 0.5 * gains.reference_ramp * data.qvel
        position, rotation = model.tip_pose(ahead)
        knot = Reference(position + action[:3], pin.exp3(action[3:6]) @ rotation, ahead + action[6:])
        for tick in range(TICKS_PER_KNOT):
            reference = blend(before, knot, min(1.0, 1e-3 * tick / gains.reference_ramp))
            model.update(data.qpos, data.qvel)
            error = pose_error(model.position, model.rotation, reference)
            torque = law.torque(model, data.qvel, data.qpos - reference.posture, error)
            data.qfrc_applied[:] = torque + model.bias
            mujoco.mj_step(plant, data)
        before = knot
        model.update(data.qpos, data.qvel)
        poses.append((model.position.copy(), model.rotation.copy()))
    return poses


@pytest.fixture(scope="module")
def flange_errors(roll_out) -> tuple[np.ndarray, np.ndarray]:
    """Position (m) and rotation (rad) errors, (H, lanes), over random states and actions."""
    random = np.random.default_rng(0)
    starts = HOME[:, None] + random.uniform(-0.4, 0.4, (7, LANES))
    actions = random.uniform(-1.0, 1.0, (3, 13, LANES)) * BOUNDS[None, :, None]
    rollout, _ = roll_out(make_problem(starts, np.zeros(3), ball(FAR_BALL)), actions)
    position, rotation = np.asarray(rollout.pose.position), np.asarray(rollout.pose.rotation)
    errors = np.array(
        [
            [
                (
                    np.linalg.norm(position[knot + 1, :, lane] - true_position),
                    np.linalg.norm(pin.log3(rotation[knot + 1, :, :, lane].astype(float) @ true_rotation.T)),
                )
                for lane in range(LANES)
                for true_position, true_rotation in [truth[lane][knot]]
            ]
            for truth in [[simulate(starts[:, lane], actions[:, :, lane]) for lane in range(LANES)]]
            for knot in range(3)
        ]
    )
    return errors[..., 0], errors[..., 1]


def test_flange_position_is_predicted_within_a_millimetre(flange_errors):
    position, _ = flange_errors
    assert position.max() < 1e-3
    assert position.mean() < 2e-4


def test_flange_rotation_is_predicted_within_half_a_degree(flange_errors):
    _, rotation = flange_errors
    assert rotation.max() < np.radians(0.5)


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
