"""Joint-limit repulsion, and the cap on torques and on their rate."""

import numpy as np
import pytest
from arm_simulation import (
    HOME,
    POSITION_LIMITS,
    REST,
    TICK_NS,
    TORQUE_LIMITS,
    VELOCITY_LIMITS,
    ClosedLoop,
    ideal_plant,
    offer_plan,
)
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.control.constants import make_constants, torque_rates
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.kernels import (
    factorise,
    limit_torque,
    null_brake,
    repulsion_torque,
    speed_limit_torque,
)
from contact_reach_ros.control.law import Reference
from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.robot import iiwa14

SETTINGS = LimitSettings()
CONSTANTS = make_constants(limits=SETTINGS)

joints = st.integers(0, 6)
sides = st.sampled_from([-1.0, 1.0])
speeds = st.floats(-3.0, 3.0)
torques = st.lists(st.floats(-1e4, 1e4), min_size=7, max_size=7).map(np.array)


def repulsion_at(joint: int, side: float, depth: float, v: np.ndarray = REST) -> np.ndarray:
    """Torque with one joint `depth` rad inside the margin before its limit."""
    q = HOME.copy()
    q[joint] = side * (POSITION_LIMITS[joint] - SETTINGS.joint_limit_margin + depth)
    return repulsion_torque(CONSTANTS, q, v)


@given(st.lists(st.floats(-1, 1), min_size=7, max_size=7), st.lists(speeds, min_size=7, max_size=7))
def test_no_repulsion_outside_of_the_margin(shares, v):
    q = np.array(shares) * (POSITION_LIMITS - SETTINGS.joint_limit_margin)
    assert not repulsion_torque(CONSTANTS, q, np.array(v)).any()


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
    cap = SETTINGS.torque_share * TORQUE_LIMITS
    previous = np.clip(first, -cap, cap)
    for torque, period in requests:
        limited = limit_torque(CONSTANTS, torque, previous, period)
        assert (np.abs(limited) <= cap).all()
        step = torque_rates(SETTINGS) * period
        assert (np.abs(limited - previous) <= step + 1e-9).all()
        # No further from the request than it has to be.
        wanted = np.clip(torque, -cap, cap)
        np.testing.assert_allclose(limited, np.clip(wanted, previous - step, previous + step), rtol=0, atol=1e-9)
        previous = limited


def test_the_torque_of_a_weaker_joint_changes_as_much_slower():
    rates = torque_rates(LimitSettings(torque_rate=3200.0))
    np.testing.assert_allclose(rates, 10.0 * TORQUE_LIMITS)


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
    CONSTANTS = make_constants(
        limits=LimitSettings(null_velocity_share=0.4, velocity_limit_share=0.8, velocity_limit_rate=100.0)
    )

    def acceleration(self, torque: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self.MASS, torque)

    def test_slow_joints_are_left_alone(self):
        assert not null_brake(self.CONSTANTS, 0.4 * VELOCITY_LIMITS, self.MASS).any()
        assert not null_brake(self.CONSTANTS, -0.4 * VELOCITY_LIMITS, self.MASS).any()
        assert not self.change(0.4 * VELOCITY_LIMITS, 1e4 * np.ones(7)).any()

    def change(self, v: np.ndarray, torque: np.ndarray) -> np.ndarray:
        factor, _ = factorise(self.MASS, 0.0)
        return speed_limit_torque(self.CONSTANTS, v, self.MASS, factor, torque)

    @pytest.mark.parametrize("side", [-1.0, 1.0])
    def test_in_the_null_space_a_fast_joint_is_decelerated_in_proportion_to_its_excess(self, side):
        v = 0.1 * VELOCITY_LIMITS
        v[2] = side * 0.7 * VELOCITY_LIMITS[2]
        braked = self.acceleration(null_brake(self.CONSTANTS, v, self.MASS))
        expected = np.zeros(7)
        expected[2] = -side * 100.0 * 0.3 * VELOCITY_LIMITS[2]
        np.testing.assert_allclose(braked, expected, rtol=0, atol=1e-9)

    @given(st.lists(st.floats(-1.2, 1.2), min_size=7, max_size=7).map(np.array), torques)
    def test_no_joint_is_driven_beyond_the_limit_and_the_others_accelerate_as_before(self, shares, torque):
        v = shares * VELOCITY_LIMITS
        before = self.acceleration(torque)
        after = self.acceleration(torque + self.change(v, torque))
        fast = np.abs(shares) > 0.4
        most = 100.0 * (0.8 - np.abs(shares)) * VELOCITY_LIMITS
        outwards = np.sign(v) * before
        expected = np.where(fast & (outwards > most), np.sign(v) * most, before)
        np.testing.assert_allclose(after, expected, rtol=1e-9, atol=1e-6)


def null_direction(loop: ClosedLoop) -> np.ndarray:
    """How the joints move, (7,) of length 1, while the flange rests: A1 outwards."""
    model = loop.controller.model
    model.update(loop.q, loop.v)
    direction = np.linalg.svd(model.jacobian)[2][-1]
    return direction * np.sign(direction[0])


POSTURE_PULL, TASK_PULL = "posture", "task"


def pulled(kind: str, settings: LimitSettings) -> tuple[ClosedLoop, float, float]:
    """The arm, its greatest speed as a share of the limits, and the flange's greatest error, m, after a strong pull.

    The references move with the flange and stay far ahead of the posture, or stay far ahead of the flange.
    """
    loop = ClosedLoop(ideal_plant(), ControllerSettings(limits=settings))
    start = loop.reference()
    fastest = farthest = 0.0

    def replan() -> None:
        if loop.now_ns % (40 * TICK_NS) == 0:
            if kind == POSTURE_PULL:
                ahead = Reference(start.position, start.rotation, loop.q + 0.2 * null_direction(loop))
            else:
                ahead = Reference(loop.reference().position + np.array([0.0, 0.12, 0.0]), start.rotation, loop.q)
            offer_plan(loop.controller, [ahead], loop.now_ns, (100 * TICK_NS,), loop.now_ns)

    for _ in loop.run(0.5, replan):
        fastest = max(fastest, float((np.abs(loop.v) / VELOCITY_LIMITS).max()))
        farthest = max(farthest, float(np.linalg.norm(loop.reference().position - start.position)))
    return loop, fastest, farthest


def test_a_fast_null_space_is_braked_without_the_task_feeling_it():
    loop, fastest, farthest = pulled(POSTURE_PULL, LimitSettings())
    assert not loop.controller.stop_reason
    assert 0.3 < fastest < 0.6
    assert farthest < 2e-3


def test_a_pull_that_would_be_too_fast_does_not_stop_the_arm():
    loop, fastest, _ = pulled(TASK_PULL, LimitSettings())
    assert not loop.controller.stop_reason
    assert 0.8 < fastest < 0.95
