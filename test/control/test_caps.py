"""Caps on what any point of the arm presses with, on its speed, and on the energy of the mass that moves with it."""

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import random_states

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.constants import body_of, make_constants
from contact_reach_ros.control.kernels import FADE, FADE_SHARE, Constant, body_shares, factorise, faded, push_share
from contact_reach_ros.control.settings import IMPACT_ENERGY, JOINT_SHARE, ImpedanceSettings, LimitSettings

LIMITS, GAINS = LimitSettings(), ImpedanceSettings()


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
            lead, fold = jacobian @ inverse @ driving[0], jacobian @ inverse @ driving[1]
            push, brake = lead + fold, jacobian @ inverse @ braking
            row = push @ jacobian / np.linalg.norm(push)
            mass = 1.0 / (row @ inverse @ row)
            way = np.linalg.norm(lead) / GAINS.task_stiffness + np.linalg.norm(fold) / GAINS.null_stiffness
            shares = np.linspace(0.0, 1.0, 20_001)[:, None]
            forces = np.minimum(mass * np.linalg.norm(shares * push + brake, axis=1), 75e3 * way * shares[:, 0])
            fits = shares[:, 0][forces <= LIMITS.tip_force]
            share = min(share, fits.max() if len(fits) else shares[forces.argmin(), 0])
    return speed, min(share, max((1.0 + FADE - speed) / FADE, 0.0))


@pytest.mark.parametrize("name", ["iiwa14", "panda", "ur10"])
def test_they_hold_at_every_end_of_a_capsule(name):
    arm = load_arm(name)
    model, constants = RobotModel(arm), make_constants(arm)
    constants[Constant.TORQUE_RATE] = np.inf
    random = np.random.default_rng(7)
    for q, v in zip(*random_states(8, 7, arm), strict=True):
        v = 0.2 * v
        model.update(q, v)
        driving = random.normal(size=(2, arm.n)) * (0.1 * arm.torque_limits, 0.02 * arm.torque_limits)
        braking = random.normal(size=arm.n) * 0.01 * arm.torque_limits
        factor, _ = factorise(model.mass_matrix, 0.0)
        found = body_shares(constants, *body_of(model), q, v, factor, driving, braking)
        np.testing.assert_allclose(found, by_pinocchio(model, q, v, driving, braking), rtol=1e-3, atol=1e-4)


def test_damping_that_balances_the_push_leaves_it_whole():
    """A steady motion is not slowed down; the same push of an arm that is blocked is."""
    push = np.array([150.0, 0.0, 0.0])
    assert push_share(push, -push, 60.0) == 1.0
    assert push_share(push, np.zeros(3), 60.0) == pytest.approx(0.4)
    assert push_share(push, np.array([0.0, 90.0, 0.0]), 60.0) == 0.0


@pytest.mark.parametrize(
    ("lever", "torque", "share"),
    [
        (0.3, 30.0, 0.6),  # 100 N on what blocks it
        (0.05, 6.0, 60.0 / 85.2),  # 120 N, but a body of 75 N/mm yields by 1.1 mm, all the way there is
        (0.004, 6.0, 1.0),  # 1500 N, but 0.09 mm
    ],
)
def test_a_point_near_an_axis_presses_no_harder_than_its_way_allows(lever, torque, share):
    """One joint of 0.3 kg m²; without that, ends of capsules some mm off an axis would hold the arm."""
    constants = make_constants(load_arm("iiwa14"))[:, :1]
    none, factor = np.zeros(1), np.array([[np.sqrt(0.3)]])
    placement, driving = np.eye(3, 4), np.array([[torque], [0.0]])
    found = body_shares(constants, placement, none, np.array([[lever, 0.0, 0.0]]), none, none, factor, driving, none)
    assert found[1] == pytest.approx(share, rel=1e-3)


def speeds_at_the_cap(late, horizon):
    """Speeds, as shares of the permitted one, of a mass that is pushed and damped, by velocities of `late` ms ago."""
    driving, damping, seen = 160.0, 100.0, [0.0] * (late + 1)
    for _ in range(2000):
        speed = seen[-1 - late]
        push = min(max(faded(speed, driving, -damping * speed, horizon, 0.0), 0.0), 1.0)
        seen.append(seen[-1] + 0.001 * (push * driving - damping * speed))
    return np.array(seen[1000:])


def test_the_fade_of_the_push_does_not_shake_an_arm_whose_torques_are_late():
    """The speed at which push and damping are in balance does not depend on the delay."""
    late = 10
    shaking = speeds_at_the_cap(late, 0.0)
    assert np.ptp(shaking) > 0.5
    steady = speeds_at_the_cap(0, 0.0)
    found = speeds_at_the_cap(late, 0.001 * late / FADE_SHARE)
    assert np.ptp(steady) < 1e-6 and 1.0 < steady[-1] < 1.0 + FADE
    np.testing.assert_allclose(found, steady[-1], atol=1e-3)
