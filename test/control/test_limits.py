"""Joint-limit repulsion, and the cap on torques and on their rate."""

import numpy as np
import pytest
from arm_simulation import (
    HOME,
    POSITION_LIMITS,
    REST,
    TICK_NS,
    TORQUE_LIMITS,
    ClosedLoop,
    ideal_plant,
    offer_plan,
)
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.control.law import Reference
from contact_reach_ros.control.limits import JointLimitRepulsion, SpeedLimiter, TorqueLimiter
from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.robot import iiwa14

SETTINGS = LimitSettings()

joints = st.integers(0, 6)
sides = st.sampled_from([-1.0, 1.0])
speeds = st.floats(-3.0, 3.0)
torques = st.lists(st.floats(-1e4, 1e4), min_size=7, max_size=7).map(np.array)


def repulsion_at(joint: int, side: float, depth: float, v: np.ndarray = REST) -> np.ndarray:
    """Torque with one joint `depth` rad inside the margin before its limit."""
    q = HOME.copy()
    q[joint] = side * (POSITION_LIMITS[joint] - SETTINGS.joint_limit_margin + depth)
    torque = JointLimitRepulsion(SETTINGS).torque(q, v)
    return np.zeros(7) if torque is None else torque


@given(st.lists(st.floats(-1, 1), min_size=7, max_size=7), st.lists(speeds, min_size=7, max_size=7))
def test_no_repulsion_outside_of_the_margin(shares, v):
    q = np.array(shares) * (POSITION_LIMITS - SETTINGS.joint_limit_margin)
    assert JointLimitRepulsion(SETTINGS).torque(q, np.array(v)) is None


@given(joints, sides, st.floats(1e-3, 0.5), speeds)
def test_repulsion_pushes_inwards_and_only_the_joint_concerned(joint, side, depth, speed):
    torque = repulsion_at(joint, side, depth, speed * np.eye(7)[joint])
    assert side * torque[joint] < 0
    assert not np.delete(torque, joint).any()


@given(joints, sides, st.floats(0.0, 0.3), st.floats(0.0, 0.3))
def test_repulsion_grows_with_the_depth(joint, side, depth, further):
    shallow, deep = (-side * repulsion_at(joint, side, at)[joint] for at in (depth, depth + further))
    assert deep >= shallow


@given(joints, sides, st.floats(-0.01, 0.3), speeds)
def test_repulsion_is_continuous(joint, side, depth, speed):
    v = speed * np.eye(7)[joint]
    step = 1e-7
    change = repulsion_at(joint, side, depth + step, v) - repulsion_at(joint, side, depth, v)
    steepest = 1e4  # Nm/rad, more than the stiffest joint has
    assert np.abs(change).max() <= steepest * step


@given(joints, sides)
def test_repulsion_at_the_limit_is_the_declared_share(joint, side):
    torque = repulsion_at(joint, side, SETTINGS.joint_limit_margin)
    assert -side * torque[joint] == pytest.approx(SETTINGS.joint_limit_torque_share * TORQUE_LIMITS[joint])
    # It grows with the square, so that it begins without a kink.
    halfway = repulsion_at(joint, side, 0.5 * SETTINGS.joint_limit_margin)
    assert halfway[joint] == pytest.approx(0.25 * torque[joint])


@given(joints, sides, st.floats(0.01, 0.3), st.floats(0.01, 3.0))
def test_only_motion_towards_the_limit_is_damped(joint, side, depth, speed):
    at_rest = repulsion_at(joint, side, depth)
    away = repulsion_at(joint, side, depth, -side * speed * np.eye(7)[joint])
    towards = repulsion_at(joint, side, depth, side * speed * np.eye(7)[joint])
    np.testing.assert_array_equal(away, at_rest)
    assert side * towards[joint] < side * at_rest[joint]


@given(torques, st.lists(st.tuples(torques, st.floats(0.0, 0.01)), min_size=1, max_size=20))
def test_limiter_keeps_cap_and_rate(first, requests):
    limiter = TorqueLimiter(SETTINGS)
    limiter.start(first)
    cap = SETTINGS.torque_share * TORQUE_LIMITS
    previous = np.clip(first, -cap, cap)
    for torque, period in requests:
        limited = limiter.limit(torque, period)
        assert (np.abs(limited) <= cap).all()
        assert (np.abs(limited - previous) <= SETTINGS.torque_rate * period + 1e-9).all()
        # No further from the request than it has to be.
        wanted = np.clip(torque, -cap, cap)
        step = SETTINGS.torque_rate * period
        np.testing.assert_allclose(limited, np.clip(wanted, previous - step, previous + step), rtol=0, atol=1e-9)
        previous = limited


def greedy_reference(loop: ClosedLoop, joint: int, side: float) -> Reference:
    """What a planner asks for at most, γ = 1 cm, 0.2 rad, 0.2 rad, in the direction that turns one joint outwards."""
    q = loop.q
    posture = q.copy()
    posture[joint] += 0.2 * side
    ahead = q.copy()
    ahead[joint] += 0.1 * side
    position, _ = loop.controller.model.flange_pose(q)
    target, target_rotation = loop.controller.model.flange_pose(ahead)
    step = target - position
    step *= min(1.0, 0.01 * np.sqrt(3.0) / max(np.linalg.norm(step), 1e-9))
    return Reference(position + step, target_rotation, posture)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", range(7), ids=iiwa14.JOINT_NAMES)
def test_plans_that_drive_a_joint_into_its_limit_do_not_get_there(joint, side):
    start = HOME.copy()
    start[joint] = side * (POSITION_LIMITS[joint] - 0.2)
    plant = ideal_plant(start)
    plant.model.jnt_limited[:] = 0  # Nothing but the controller keeps the joint from crossing.
    loop = ClosedLoop(plant)
    period_ns = 40 * TICK_NS
    near = False

    def replan() -> None:
        if loop.now_ns % period_ns == 0:
            plan = greedy_reference(loop, joint, side)
            offer_plan(loop.controller, [plan], loop.now_ns, (3 * period_ns,), loop.now_ns)

    for _ in loop.run(1.5, replan):
        near = near or side * loop.q[joint] > POSITION_LIMITS[joint] - SETTINGS.joint_limit_margin
        assert side * loop.q[joint] < POSITION_LIMITS[joint]
    assert near


class TestSpeedLimiter:
    MASS = np.diag([4.0, 3.0, 2.0, 1.0, 0.5, 0.1, 0.01]) + 0.002
    LIMITS = np.array(iiwa14.VELOCITY_LIMITS)

    def test_slow_joints_are_left_alone(self):
        limiter = SpeedLimiter(LimitSettings(velocity_limit_share=0.6))
        assert limiter.torque(0.6 * self.LIMITS, self.MASS) is None
        assert limiter.torque(-0.6 * self.LIMITS, self.MASS) is None

    @pytest.mark.parametrize("side", [-1.0, 1.0])
    def test_a_fast_joint_alone_is_decelerated_in_proportion_to_its_excess(self, side):
        limiter = SpeedLimiter(LimitSettings(velocity_limit_share=0.6, velocity_limit_rate=100.0))
        v = 0.1 * self.LIMITS
        v[2] = side * 0.9 * self.LIMITS[2]
        acceleration = np.linalg.solve(self.MASS, limiter.torque(v, self.MASS))
        expected = np.zeros(7)
        expected[2] = -side * 100.0 * 0.3 * self.LIMITS[2]
        np.testing.assert_allclose(acceleration, expected, rtol=0, atol=1e-9)
