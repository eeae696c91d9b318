"""Joints stay within their limits, torques and their rates within the caps."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, POSITION_LIMITS, TICK_NS, TORQUE_LIMITS, ClosedLoop, ideal_plant, offer_plan
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.control.constants import REPULSION_MARGIN, make_constants, torque_rates
from contact_reach_ros.control.kernels import limit_torque
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import LimitSettings

SETTINGS = LimitSettings()
CONSTANTS = make_constants(ARM, limits=SETTINGS)

torques = st.lists(st.floats(-1e4, 1e4), min_size=ARM.n, max_size=ARM.n).map(np.array)


@given(torques, st.lists(st.tuples(torques, st.floats(0.0, 0.01)), min_size=1, max_size=20))
def test_limiter_keeps_cap_and_rate(first, requests):
    cap = SETTINGS.torque_share * TORQUE_LIMITS
    previous = np.clip(first, -cap, cap)
    for torque, period in requests:
        limited = limit_torque(CONSTANTS, torque, previous, period)
        assert (np.abs(limited) <= cap).all()
        step = torque_rates(ARM, SETTINGS) * period
        assert (np.abs(limited - previous) <= step + 1e-9).all()
        # Straight towards what was asked for, and as far as the joint permits that has the farthest to go.
        way = np.clip(torque, -cap, cap) - previous
        share = (step / np.maximum(np.abs(way), step + 1e-300)).min()
        np.testing.assert_allclose(limited, previous + share * way, rtol=0, atol=1e-9)
        previous = limited


def greedy_reference(loop: ClosedLoop, joint: int, side: float) -> Reference:
    """What a planner asks for at most, γ = 1 cm, 0.2 rad, 0.2 rad, in the direction that turns one joint outwards."""
    q = loop.q
    posture = q.copy()
    posture[joint] += 0.2 * side
    ahead = q.copy()
    ahead[joint] += 0.1 * side
    position, _ = loop.controller.model.tip_pose(q)
    target, target_rotation = loop.controller.model.tip_pose(ahead)
    step = target - position
    step *= min(1.0, 0.01 * np.sqrt(3.0) / max(np.linalg.norm(step), 1e-9))
    return Reference(position + step, target_rotation, posture)


@pytest.mark.parametrize(("joint", "side"), [(joint, (-1.0) ** joint) for joint in range(ARM.n)])
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
        near = near or side * loop.q[joint] > POSITION_LIMITS[joint] - REPULSION_MARGIN
        assert side * loop.q[joint] < POSITION_LIMITS[joint]
    assert near
