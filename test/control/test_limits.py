"""Joints stay within their limits of position and speed, torques and their rates within the caps."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import (
    ARM,
    HOME,
    NO_FRICTION,
    POSITION_LIMITS,
    TICK_NS,
    TORQUE_LIMITS,
    UNWATCHED,
    VELOCITY_LIMITS,
    ClosedLoop,
    ideal_plant,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from contact_reach_ros.control.constants import make_constants, torque_rates
from contact_reach_ros.control.kernels import FADE, REPULSION_MARGIN, limit_torque
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import JOINT_SHARE, ImpedanceSettings, LimitSettings
from contact_reach_ros.simulation.plant import FRICTION, TICK

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


@pytest.mark.parametrize("delay", [0.0, 0.01])
@pytest.mark.parametrize(("joint", "side"), [(joint, (-1.0) ** joint) for joint in range(ARM.n)])
def test_plans_that_drive_a_joint_into_its_limit_do_not_get_there(joint, side, delay):
    """Also with torques that act 10 ms late, as on a KUKA at 500 Hz, with the friction of such an arm."""
    start = HOME.copy()
    start[joint] = side * (POSITION_LIMITS[joint] - 0.2)
    plant = ideal_plant(start, friction=FRICTION if delay else NO_FRICTION)
    plant.model.jnt_limited[:] = 0  # Nothing but the controller keeps the joint from crossing.
    period = 0.002 if delay else TICK
    limits = dataclasses.replace(SETTINGS, torque_delay=delay)
    impedance = ImpedanceSettings(null_stiffness=25.0, null_damping=0.9)  # Of config/lbr.yaml.
    settings = dataclasses.replace(UNWATCHED, limits=limits, impedance=impedance)
    loop = ClosedLoop(plant, settings, round(delay / period), period)
    period_ns = 40 * TICK_NS
    near = False

    def replan() -> None:
        if loop.now_ns % period_ns == 0:
            loop.plan([greedy_reference(loop, joint, side)], 3 * period_ns)

    for _ in loop.run(2.0, replan):
        near = near or side * loop.q[joint] > POSITION_LIMITS[joint] - REPULSION_MARGIN
        assert side * loop.q[joint] < POSITION_LIMITS[joint]
    assert near and not loop.controller.stop_reason


@pytest.mark.parametrize("joint", [0, 4, 5, 6])
def test_an_arm_that_starts_near_a_limit_is_not_thrown_off_it(joint):
    start = HOME.copy()
    start[joint] = POSITION_LIMITS[joint] - 0.3 * REPULSION_MARGIN
    loop = ClosedLoop(ideal_plant(start))
    for _ in loop.run(1.5):
        assert np.abs(loop.v[joint]) < 0.45
    assert not loop.controller.stop_reason
    assert 0.4 < (POSITION_LIMITS[joint] - loop.q[joint]) / REPULSION_MARGIN < 1.0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_light_direction_near_a_singularity_is_not_driven_beyond_the_cap(side):
    """A1 against A3 with A2 almost straight: it speeds up faster than the torques, limited in their rate, can end."""
    start = np.array([0.08, 0.04, -0.084, -1.46, 0.345, 1.185, -0.062])
    loop, fastest = ClosedLoop(ideal_plant(start)), 0.0
    first = loop.reference()
    ahead = first.position + np.array([0.0, 0.06 * side, 0.0])
    turned = start + 0.2 * side * np.array([1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0])
    for tick, _ in enumerate(loop.run(0.6)):
        if tick == 100:
            loop.plan([Reference(ahead, first.rotation, turned)], loop.now_ns + 300 * TICK_NS)
        fastest = max(fastest, float((np.abs(loop.v) / (JOINT_SHARE * VELOCITY_LIMITS)).max()))
    assert 0.5 < fastest < 1.0 + FADE and not loop.controller.stop_reason


def null_direction(loop: ClosedLoop) -> np.ndarray:
    """How the joints move, (7,) of length 1, while the flange rests: A1 outwards."""
    model = loop.controller.model
    model.update(loop.q, loop.v)
    direction = np.linalg.svd(model.jacobian)[2][-1]
    return direction * np.sign(direction[0])


@pytest.mark.parametrize(("pulled", "least", "most"), [("posture", 0.3, 0.6), ("flange", 0.2, 0.5)])
def test_a_joint_that_a_plan_pulls_too_fast_is_braked_and_no_stop_is_needed(pulled, least, most):
    """References stay far ahead of the posture, which the flange must not feel, or far ahead of the flange."""
    loop = ClosedLoop(ideal_plant())
    start = loop.reference()
    fastest = farthest = 0.0

    def replan() -> None:
        if loop.now_ns % (40 * TICK_NS) == 0:
            if pulled == "posture":
                ahead = Reference(start.position, start.rotation, loop.q + 0.2 * null_direction(loop))
            else:
                ahead = Reference(loop.reference().position + np.array([0.0, 0.12, 0.0]), start.rotation, loop.q)
            loop.plan([ahead], 100 * TICK_NS)

    for _ in loop.run(0.5, replan):
        fastest = max(fastest, float((np.abs(loop.v) / VELOCITY_LIMITS).max()))
        farthest = max(farthest, float(np.linalg.norm(loop.reference().position - start.position)))
    assert not loop.controller.stop_reason
    assert least < fastest < most
    assert pulled == "flange" or farthest < 2e-3


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
            loop.plan([wanted], 60 * TICK_NS)

    for _ in loop.run(1.0, replan):
        if loop.controller.stop_reason:
            break
        assert (np.abs(loop.v) < VELOCITY_LIMITS).all()
    assert "rad/s" not in loop.controller.stop_reason
