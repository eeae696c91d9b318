"""Caps on what any point of the arm presses with, on its speed, and on the energy of the mass that moves with it."""

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import random_states

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.constants import body_of, make_constants
from contact_reach_ros.control.kernels import (
    FADE,
    FADE_SHARE,
    Constant,
    body_shares,
    factorise,
    faded,
    joint_frames,
    mobility_of,
    point_jacobian,
    pressing_share,
)
from contact_reach_ros.control.settings import IMPACT_ENERGY, JOINT_SHARE, LimitSettings

LIMITS = LimitSettings()
NORMALS = np.random.default_rng(0).normal(size=(20_000, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)


HEAVIEST = 200.0


def bounded(push, drag, inverse) -> float:
    """Share of a push with which the bound on the force holds, by trying shares, and how much of the damping counts."""
    values = np.linalg.eigvalsh(inverse)
    shares, parts = np.linspace(0.0, 1.0, 4001), np.linspace(0.0, 1.0, 401)[:, None]
    squares = shares**2 * (push @ inverse @ push) + 2.0 * shares * parts * (push @ inverse @ drag)
    squares = (squares + parts**2 * (drag @ inverse @ drag)).min(axis=0)
    fits = squares * (values.mean() + np.sqrt(2.0) * values.std()) <= LIMITS.tip_force**2
    return shares[np.argmin(fits) - 1] if not fits.all() else 1.0


def points_of(arm):
    """Links and points of the capsules' axes, three of each, and the tip, as the caps look at them."""
    axes = ((capsule.link, np.array(capsule.start), np.array(capsule.end)) for capsule in arm.capsules)
    along = [(link, start + share * (end - start)) for link, start, end in axes for share in (0.0, 0.5, 1.0)]
    return [*along, (arm.n, np.array(arm.tip_offset))]


def by_pinocchio(constants, model: RobotModel, q, v, driving, braking) -> tuple[float, float]:
    """The two shares from Pinocchio's Jacobians, point by point."""
    arm, joints, data = model.arm, model.pinocchio, model.pinocchio.createData()
    inverse = np.linalg.inv(model.mass_matrix)
    speed, share, most = float((np.abs(v) / (JOINT_SHARE * arm.velocity_limits)).max()), 1.0, 1.0
    pin.computeJointJacobians(joints, data, q)
    for link, point in points_of(arm):
        joint = joints.getJointId(arm.joint_names[link - 1])
        whole = pin.getJointJacobian(joints, data, joint, pin.LOCAL_WORLD_ALIGNED)
        jacobian = whole[:3] + np.cross(whole[3:].T, data.oMi[joint].rotation @ point).T
        motion = jacobian @ v
        fast = np.linalg.norm(motion)
        if fast < 1e-3:
            # On the axis of A1.
            continue
        mobility = jacobian @ inverse @ jacobian.T
        energy = 0.5 * motion @ np.linalg.solve(mobility + 1e-9 * np.eye(3), motion)
        speed = max(speed, fast / LIMITS.body_speed, np.sqrt(energy / IMPACT_ENERGY))
        push = jacobian @ inverse @ driving
        drag, weighed = jacobian @ inverse @ braking, mobility + np.eye(3) / HEAVIEST
        share = min(share, bounded(push, drag, np.linalg.inv(weighed)))
        # A smooth surface that blocks the point; the force is in proportion to the acceleration along its normal.
        pushed, dragged = NORMALS @ push, np.minimum(NORMALS @ drag, 0.0)
        permitted = LIMITS.tip_force * np.einsum("nx,xy,ny->n", NORMALS, weighed, NORMALS)
        most = min(most, ((permitted - dragged) / pushed)[pushed > 0.0].min())
    holding = (constants[Constant.HOLD] / np.abs(driving)).min()
    assert share <= 1.001 * most
    return speed, min(max(share, holding), max((1.0 + FADE - speed) / FADE, 0.0))


@pytest.mark.parametrize("name", ["iiwa14", "panda", "ur10"])
def test_they_hold_at_three_points_of_every_capsule_and_at_the_tip(name):
    arm = load_arm(name)
    model, constants = RobotModel(arm), make_constants(arm)
    constants[Constant.TORQUE_RATE] = np.inf
    random = np.random.default_rng(7)
    for q, v in zip(*random_states(8, 7, arm), strict=True):
        v = 0.2 * v
        model.update(q, v)
        driving = random.normal(size=arm.n) * 0.1 * arm.torque_limits
        braking = random.normal(size=arm.n) * random.choice([0.01, 0.1]) * arm.torque_limits
        factor, _ = factorise(model.mass_matrix, 0.0)
        found = body_shares(constants, *body_of(model), q, v, factor, driving, braking)
        np.testing.assert_allclose(found, by_pinocchio(constants, model, q, v, driving, braking), rtol=3e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["iiwa14", "fr3", "ur10"])
def test_surfaces_that_block_any_point_of_a_link_feel_little_more(name):
    """Anywhere along the capsules, with the mass that the point has: 60 N, and more as a share of 200 kg."""
    arm = load_arm(name)
    model, constants = RobotModel(arm), make_constants(arm)
    constants[Constant.HOLD] = 0.0
    random, none, worst = np.random.default_rng(3), np.zeros(arm.n), 0.0
    for q, _ in zip(*random_states(60, 3, arm), strict=True):
        model.update(q, none)
        driving = random.normal(size=arm.n) * 0.1 * arm.torque_limits
        factor, _ = factorise(model.mass_matrix, 0.0)
        body = body_of(model)
        share = body_shares(constants, *body, q, none, factor, driving, none)[1]
        rotations, origins = joint_frames(body.placements, q)
        acceleration = share * np.linalg.solve(model.mass_matrix, driving)
        for capsule in arm.capsules:
            start, end = np.array(capsule.start), np.array(capsule.end)
            for part in np.linspace(0.0, 1.0, 9):
                rows = point_jacobian(rotations, origins, capsule.link - 1, start + part * (end - start))
                pushed, mobility = NORMALS[:2000] @ (rows.T @ acceleration), mobility_of(rows, factor)
                masses = 1.0 / np.einsum("nx,xy,ny->n", NORMALS[:2000], mobility, NORMALS[:2000])
                worst = max(worst, (pushed * masses / (1.0 + masses / HEAVIEST)).max())
    assert 40.0 < worst < 1.15 * LIMITS.tip_force


def pressing(push, drag, mobility=(1.0, 1.0, 1.0)):
    return pressing_share(np.array(push), np.array(drag), np.diag(mobility), 60.0)


def test_damping_that_balances_the_push_leaves_it_whole():
    """A steady motion is not slowed down; the same push of an arm that is blocked is."""
    assert pressing([150.0, 0.0, 0.0], [-150.0, 0.0, 0.0]) == 1.0
    assert pressing([150.0, 0.0, 0.0], [0.0, 0.0, 0.0]) == pytest.approx(0.4)
    assert pressing([150.0, 0.0, 0.0], [0.0, 90.0, 0.0]) == pytest.approx(0.4)


def test_a_surface_may_be_turned_to_where_the_point_is_heavy():
    """A point of 1 kg that weighs 100 kg across its push: a surface at 84° is pressed with five times as much."""
    angles = np.linspace(0.0, 0.5 * np.pi, 10_000)[:-1]
    worst = (np.cos(angles) / (np.cos(angles) ** 2 + 0.01 * np.sin(angles) ** 2)).max()
    assert worst > 5.0
    assert 0.5 <= worst * pressing([60.0, 0.0, 0.0], [0.0, 0.0, 0.0], (1.0, 0.01, 1.0)) <= 1.0
    assert pressing([0.0, 0.9, 0.0], [0.0, 0.0, 0.0], (1.0, 0.01, 1.0)) == pytest.approx(60.0 / 90.0)


@pytest.mark.parametrize(
    ("lever", "torque"),
    [
        (0.3, 6.0),  # 20 N on what blocks it straight, but more as a wedge
        (0.05, 3.0),  # 60 N
        (0.004, 6.0),  # 1500 N, but 0.09 mm
    ],
)
def test_a_point_near_an_axis_does_not_hold_the_arm(lever, torque):
    """One joint of 0.3 kg m²."""
    constants = make_constants(load_arm("iiwa14"))[:, :1]
    constants[Constant.HOLD] = 0.0
    none, factor = np.zeros(1), np.array([[np.sqrt(0.3)]])
    placement, driving = np.eye(3, 4), np.array([torque])
    found = body_shares(constants, placement, none, np.array([[lever, 0.0, 0.0]]), none, none, factor, driving, none)
    acceleration, mobility, shares = torque / 0.3 * lever, lever**2 / 0.3, np.cos(np.linspace(0.0, 1.57, 10_000))
    force = (acceleration * shares / (mobility * shares**2 + 1.0 / HEAVIEST)).max()
    assert 0.4 <= found[1] / min(60.0 / force, 1.0) <= 1.0 and found[1] > 0.25


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
