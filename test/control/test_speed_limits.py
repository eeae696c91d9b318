"""What keeps the joints below their speed limits."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import (
    ARM,
    POSITION_LIMITS,
    TICK_NS,
    UNWATCHED,
    VELOCITY_LIMITS,
    ClosedLoop,
    ideal_plant,
    offer_plan,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from contact_reach_ros.control.constants import make_constants, torque_rates
from contact_reach_ros.control.kernels import (
    Constant,
    keep_speed,
    null_brake,
    permitted_acceleration,
    speed_limit_torque,
)
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import LimitSettings

torques = st.lists(st.floats(-1e4, 1e4), min_size=ARM.n, max_size=ARM.n).map(np.array)
speed_shares = st.lists(st.floats(-1.2, 1.2), min_size=ARM.n, max_size=ARM.n).map(np.array)


class TestSpeedLimiter:
    MASS = np.diag([4.0, 3.0, 2.0, 1.0, 0.5, 0.1, 0.01]) + 0.002
    INVERSE = np.linalg.inv(MASS)
    CONSTANTS = make_constants(ARM)
    CONSTANTS[Constant.BRAKED_SPEED] = 0.4 * VELOCITY_LIMITS
    CONSTANTS[Constant.SPEED_CEILING] = 0.8 * VELOCITY_LIMITS
    CEILING = 0.8 * VELOCITY_LIMITS

    def permitted(self, left: np.ndarray) -> np.ndarray:
        return np.array([permitted_acceleration(self.CONSTANTS, i, left[i], self.INVERSE) for i in range(ARM.n)])

    def bounds(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest acceleration of each joint (7,), rad/s²; of a joint that is too fast, its braking."""
        least, most = -self.permitted(self.CEILING + v), self.permitted(self.CEILING - v)
        return np.where(v > 0.0, np.minimum(least, most), least), np.where(v > 0.0, most, np.maximum(least, most))

    @pytest.mark.parametrize("side", [-1.0, 1.0])
    def test_in_the_null_space_a_fast_joint_is_decelerated_in_proportion_to_its_excess(self, side):
        v = 0.1 * VELOCITY_LIMITS
        v[2] = side * 0.7 * VELOCITY_LIMITS[2]
        braked = self.INVERSE @ null_brake(self.CONSTANTS, v, self.MASS)
        expected = np.zeros(ARM.n)
        expected[2] = -side * 100.0 * 0.3 * VELOCITY_LIMITS[2]
        np.testing.assert_allclose(braked, expected, rtol=0, atol=1e-9)

    @given(speed_shares, torques)
    def test_no_joint_is_driven_beyond_the_limit_and_the_others_accelerate_as_before(self, shares, torque):
        v = shares * VELOCITY_LIMITS
        before = self.INVERSE @ torque
        after = self.INVERSE @ (torque + speed_limit_torque(self.CONSTANTS, v, self.MASS, self.INVERSE, torque))
        least, most = self.bounds(v)
        expected = np.clip(before, least, most)
        np.testing.assert_allclose(after, expected, rtol=1e-8, atol=1e-6)

    @given(speed_shares, torques, torques)
    def test_what_keeps_the_speed_stays_within_the_torque_limits(self, shares, previous, wish):
        v, step = shares * VELOCITY_LIMITS, torque_rates(ARM, LimitSettings()) * 1e-3
        cap = self.CONSTANTS[Constant.TORQUE_CAP]
        previous = np.clip(previous, -cap, cap)
        before = np.clip(np.clip(wish, previous - step, previous + step), -cap, cap)
        after = before.copy()
        keep_speed(self.CONSTANTS, v, self.INVERSE, before, after, previous, 1e-3)
        assert (np.abs(after) <= cap).all() and (np.abs(after - previous) <= step + 1e-9).all()
        least, most = self.bounds(v)
        acceleration = self.INVERSE @ before
        if (acceleration <= most).all() and (acceleration >= least).all():
            assert (after == before).all()

    @pytest.mark.parametrize("joint", range(ARM.n))
    @pytest.mark.parametrize(("side", "excess"), [(-1.0, 0.001), (1.0, 0.1)])
    def test_a_joint_that_is_too_fast_brakes_by_its_own_torque_as_far_as_its_rate_permits(self, joint, side, excess):
        v, rest, after = np.zeros(ARM.n), np.zeros(ARM.n), np.zeros(ARM.n)
        v[joint] = side * (1.0 + excess) * self.CEILING[joint]
        keep_speed(self.CONSTANTS, v, self.INVERSE, rest, after, rest, 1e-3)
        wanted = -100.0 * excess * self.CEILING[joint] / self.INVERSE[joint, joint]
        expected = rest.copy()
        expected[joint] = side * max(wanted, -torque_rates(ARM, LimitSettings())[joint] * 1e-3)
        np.testing.assert_allclose(after, expected, rtol=1e-9)


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
    loop = ClosedLoop(ideal_plant(), dataclasses.replace(UNWATCHED, limits=settings))
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


@pytest.mark.parametrize("seed", [2, 9, 12])
def test_references_that_jump_about_near_a_singularity_do_not_make_a_joint_too_fast(seed):
    """Every 40 ms the farthest that a plan may ask for, elsewhere six times a second."""
    random = np.random.default_rng(seed)
    loop = ClosedLoop(ideal_plant(random.uniform(-0.7, 0.7, 7) * POSITION_LIMITS))
    loop.controller.model.update(loop.q, loop.v)
    assert np.linalg.svd(loop.controller.model.jacobian)[1][-1] < 0.2
    wish = np.sign(random.normal(size=6))

    def replan() -> None:
        nonlocal wish
        if loop.now_ns % (160 * TICK_NS) == 0:
            wish = np.sign(random.normal(size=6))
        if loop.now_ns % (40 * TICK_NS) == 0:
            here = loop.reference()
            turned = Rotation.from_rotvec(0.2 * wish[3:]).as_matrix() @ here.rotation
            wanted = Reference(here.position + 0.01 * wish[:3], turned, here.posture)
            offer_plan(loop.controller, [wanted], loop.now_ns, (60 * TICK_NS,), loop.now_ns)

    for _ in loop.run(1.0, replan):
        if loop.controller.stop_reason:
            break
        assert (np.abs(loop.v) < VELOCITY_LIMITS).all()
    assert "rad/s" not in loop.controller.stop_reason
