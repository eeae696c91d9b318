"""Caps on what any point of the arm presses with, on its speed, and on the energy of the mass that moves with it."""

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import random_states

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.constants import JOINT_SHARE, body_of, make_constants
from contact_reach_ros.control.kernels import body_shares, factorise, push_share
from contact_reach_ros.control.settings import IMPACT_ENERGY, LimitSettings

LIMITS = LimitSettings()


def by_pinocchio(model: RobotModel, q, v, driving, braking) -> tuple[float, float]:
    """The two shares from Pinocchio's Jacobians, point by point."""
    arm, joints, data = model.arm, model.pinocchio, model.pinocchio.createData()
    inverse = np.linalg.inv(model.mass_matrix)
    speed, share = float((np.abs(v) / (JOINT_SHARE * arm.velocity_limits)).max()), 1.0
    pin.computeJointJacobians(joints, data, q)
    for capsule in arm.capsules:
        joint = joints.getJointId(arm.joint_names[capsule.link - 1])
        whole = pin.getJointJacobian(joints, data, joint, pin.LOCAL_WORLD_ALIGNED)
        for end in (capsule.start, capsule.end):
            lever = data.oMi[joint].rotation @ np.array(end, float)
            jacobian = whole[:3] + np.cross(whole[3:].T, lever).T
            motion = jacobian @ v
            fast = np.linalg.norm(motion)
            if fast < 1e-3:
                # On the axis of A1.
                continue
            row = motion @ jacobian / fast
            energy = 0.5 * fast**2 / (row @ inverse @ row)
            speed = max(speed, fast / LIMITS.body_speed, np.sqrt(energy / IMPACT_ENERGY))
            push, brake = jacobian @ inverse @ driving, jacobian @ inverse @ braking
            row = push @ jacobian / np.linalg.norm(push)
            mass = 1.0 / (row @ inverse @ row)
            shares = np.linspace(0.0, 1.0, 20_001)[:, None]
            forces = mass * np.linalg.norm(shares * push + brake, axis=1)
            fits = shares[:, 0][forces <= LIMITS.tip_force]
            share = min(share, fits.max() if len(fits) else shares[forces.argmin(), 0])
    return speed, share


@pytest.mark.parametrize("name", ["iiwa14", "panda", "ur10"])
def test_they_hold_at_every_end_of_a_capsule(name):
    arm = load_arm(name)
    model, constants = RobotModel(arm), make_constants(arm)
    random = np.random.default_rng(7)
    for q, v in zip(*random_states(8, 7, arm), strict=True):
        v = 0.2 * v
        model.update(q, v)
        driving, braking = random.normal(size=(2, arm.n)) * (0.1 * arm.torque_limits, 0.01 * arm.torque_limits)
        factor, _ = factorise(model.mass_matrix, 0.0)
        found = body_shares(constants, *body_of(model), q, v, factor, driving, braking)
        np.testing.assert_allclose(found, by_pinocchio(model, q, v, driving, braking), rtol=1e-3, atol=1e-4)


def test_damping_that_balances_the_push_leaves_it_whole():
    """A steady motion is not slowed down; the same push of an arm that is blocked is."""
    push = np.array([150.0, 0.0, 0.0])
    assert push_share(push, -push, 60.0) == 1.0
    assert push_share(push, np.zeros(3), 60.0) == pytest.approx(0.4)
    assert push_share(push, np.array([0.0, 90.0, 0.0]), 60.0) == 0.0
