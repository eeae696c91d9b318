"""The laws (1)-(3) and (6): what the torques do to the arm."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME, REST, mobility, null_space_projection, random_states
from hypothesis import given
from hypothesis import strategies as st
from six_axis import SIX_AXIS

from benchmarks.law import ImpedanceLaw, pose_error
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import SINGULARITY_FLOOR, ImpedanceSettings

SETTINGS = ImpedanceSettings()


def reference_at(model: RobotModel, q: np.ndarray) -> Reference:
    return Reference(*model.tip_pose(q), q)


def law_torque(law: ImpedanceLaw, model: RobotModel, q: np.ndarray, v: np.ndarray, reference: Reference) -> np.ndarray:
    """τ of law (3) without C + g; the model is updated."""
    model.update(q, v)
    return law.torque(model, v, q - reference.posture, pose_error(model.position, model.rotation, reference))


def regular_states(model: RobotModel, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Random states where Λ is the true inverse."""
    found = []
    for q, v in zip(*random_states(20 * count), strict=True):
        model.update(q, v)
        if np.linalg.eigvalsh(mobility(model))[0] > SINGULARITY_FLOOR:
            found.append((q, v))
    assert len(found) >= count
    return found[:count]


def test_task_acceleration_is_what_law_one_asks_for():
    model, law = RobotModel(ARM), ImpedanceLaw(ARM, SETTINGS)
    reference = reference_at(model, HOME)
    for q, v in regular_states(model, 100):
        torque = law_torque(law, model, q, v, reference)
        error = pose_error(model.position, model.rotation, reference)
        joint_acceleration = pin.aba(model.pinocchio, model.pinocchio.createData(), q, v, torque + model.bias)
        acceleration = model.jacobian @ joint_acceleration + model.drift
        wanted = -SETTINGS.task_stiffness * error - SETTINGS.task_damping * model.twist
        np.testing.assert_allclose(acceleration, wanted, rtol=0, atol=1e-8)


@pytest.mark.parametrize("arm", [ARM, SIX_AXIS], ids=lambda arm: arm.name)
def test_task_of_positions_controls_three_rows_and_leaves_the_rest_to_law_two(arm):
    model, random = RobotModel(arm), np.random.default_rng(3)
    settings = ImpedanceSettings(task="position")
    law = ImpedanceLaw(arm, settings)
    for _ in range(50):
        q, v = random.uniform(arm.lower, arm.upper), random.normal(0.0, 0.5, arm.n)
        model.update(q, v)
        rows = model.jacobian[:3]
        if np.linalg.eigvalsh(rows @ np.linalg.solve(model.mass_matrix, rows.T))[0] < SINGULARITY_FLOOR:
            continue
        error, postures = random.uniform(-0.1, 0.1, 6), random.uniform(-1.0, 1.0, (2, arm.n))
        torques = [law.torque(model, v, posture, error) for posture in postures]
        accelerations = [np.linalg.solve(model.mass_matrix, torque) for torque in torques]
        wanted = -settings.task_stiffness * error[:3] - settings.task_damping * model.twist[:3]
        for acceleration in accelerations:
            np.testing.assert_allclose(rows @ acceleration + model.drift[:3], wanted, rtol=0, atol=1e-8)
        # Law (2) turns the tip.
        assert np.linalg.norm(model.jacobian[3:] @ (accelerations[1] - accelerations[0])) > 0.1
        np.testing.assert_array_equal(torques[0], law.torque(model, v, postures[0], error * [1, 1, 1, 9, 9, 9]))


@pytest.mark.parametrize("arm", [ARM, SIX_AXIS], ids=lambda arm: arm.name)
def test_task_of_position_and_axis_turns_the_axis_as_asked_and_leaves_the_rotation_about_it_to_law_two(arm):
    model, random = RobotModel(arm), np.random.default_rng(4)
    settings = ImpedanceSettings(task="position_and_axis")
    law = ImpedanceLaw(arm, settings)
    for _ in range(50):
        q, v = random.uniform(arm.lower, arm.upper), random.normal(0.0, 0.5, arm.n)
        model.update(q, v)
        x, y, z = model.rotation.T
        rows = np.concatenate([model.jacobian[:3], [x, y] @ model.jacobian[3:]])
        if np.linalg.eigvalsh(rows @ np.linalg.solve(model.mass_matrix, rows.T))[0] < SINGULARITY_FLOOR:
            continue
        # However the reference is turned about its axis.
        about, tilt = pin.exp3(random.uniform(-3.0, 3.0) * z), pin.exp3(random.uniform(-0.5, 0.5, 3))
        reference = Reference(model.position - 0.1, tilt @ about @ model.rotation, q)
        error = pose_error(model.position, model.rotation, reference, settings.task)
        np.testing.assert_allclose(pin.exp3(error[3:]) @ reference.rotation[:, 2], z, rtol=0, atol=1e-9)
        assert abs(error[3:] @ z) < 1e-9
        torques = [law.torque(model, v, posture, error) for posture in random.uniform(-1.0, 1.0, (2, arm.n))]
        accelerations = [np.linalg.solve(model.mass_matrix, torque) for torque in torques]
        wanted = -settings.task_stiffness * error - settings.task_damping * model.twist
        for acceleration in accelerations:
            # ω × ż is what turns the axis although nothing accelerates.
            twist = model.jacobian @ acceleration + model.drift
            np.testing.assert_allclose(twist[:3], wanted[:3], rtol=0, atol=1e-8)
            np.testing.assert_allclose(np.cross(twist[3:], z), np.cross(wanted[3:], z), rtol=0, atol=1e-8)
        assert abs(z @ model.jacobian[3:] @ (accelerations[1] - accelerations[0])) > 0.01


def test_law_is_the_sum_of_the_papers_terms():
    model, law = RobotModel(ARM), ImpedanceLaw(ARM, SETTINGS)
    reference = reference_at(model, HOME)
    for q, v in regular_states(model, 20):
        torque = law_torque(law, model, q, v, reference)
        error = pose_error(model.position, model.rotation, reference)
        command = -SETTINGS.task_stiffness * error - SETTINGS.task_damping * model.twist - model.drift
        posture = -SETTINGS.null_stiffness * (q - reference.posture) - SETTINGS.null_damping * v
        expected = model.jacobian.T @ np.linalg.inv(mobility(model)) @ command
        expected += null_space_projection(model).T @ posture
        np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def simulate(start: tuple[np.ndarray, np.ndarray], reference: Reference, step: float, seconds: float) -> np.ndarray:
    """Task errors (N, 6) of MuJoCo's arm under the law at the end of each millisecond."""
    simulated = mujoco.MjModel.from_xml_string(build_mjcf(ARM))
    simulated.opt.timestep = step
    data = mujoco.MjData(simulated)
    data.qpos[:], data.qvel[:] = start
    model, law, errors = RobotModel(ARM), ImpedanceLaw(ARM, SETTINGS), []
    per_millisecond = round(1e-3 / step)
    for tick in range(round(seconds / step)):
        data.ctrl[:] = law_torque(law, model, data.qpos.copy(), data.qvel.copy(), reference) + model.bias
        mujoco.mj_step(simulated, data)
        if (tick + 1) % per_millisecond == 0:
            errors.append(pose_error(*model.tip_pose(data.qpos), reference))
    return np.array(errors)


def second_order_law(error: np.ndarray, rate: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Solution (N, 6) of ë + Kd ė + Kp e = 0."""
    slow, fast = np.roots([1.0, SETTINGS.task_damping, SETTINGS.task_stiffness])[::-1]
    growth_slow, growth_fast = np.exp(slow * times)[:, None], np.exp(fast * times)[:, None]
    return ((rate - fast * error) * growth_slow - (rate - slow * error) * growth_fast) / (slow - fast)


@pytest.mark.parametrize("moving", [False, True], ids=["from rest", "moving"])
def test_task_error_follows_the_second_order_law(moving):
    model, seconds = RobotModel(ARM), 0.15
    position, rotation = model.tip_pose(HOME)
    # The null space is kept busy too; the task must not notice.
    posture = HOME + np.array([0.3, -0.2, 0.4, 0.1, -0.3, 0.2, 0.3])
    reference = Reference(position - (0.03, -0.04, 0.05), pin.exp3(np.array([-0.2, 0.1, 0.15])) @ rotation, posture)
    v = np.array([0.6, -0.5, 0.4, 0.7, -0.6, 0.5, 0.8]) if moving else REST
    model.update(HOME, v)
    times = 1e-3 * np.arange(1, round(1000 * seconds) + 1)
    expected = second_order_law(pose_error(position, rotation, reference), model.twist, times)
    # The law is exact for translation, and for rotation about a fixed axis, which a start from rest gives.
    part = slice(0, 3) if moving else slice(0, 6)
    coarse, fine = (simulate((HOME, v), reference, step, seconds)[:, part] for step in (1e-3, 5e-4))
    deviation_coarse = np.abs(coarse - expected[:, part]).max()
    deviation_fine = np.abs(fine - expected[:, part]).max()
    # What deviates is the integration: it halves with the step, and is gone when extrapolated to step zero.
    assert deviation_fine == pytest.approx(0.5 * deviation_coarse, rel=0.15)
    np.testing.assert_allclose(2 * fine - coarse, expected[:, part], rtol=0, atol=2e-5)
    assert np.abs(expected).max() > 0.05


@pytest.mark.parametrize("short_of_half_a_turn", [0.0, 1e-12, 1e-8, 1e-4, 0.1, 1.0])
def test_pose_error_is_right_up_to_half_a_turn(short_of_half_a_turn):
    random = np.random.default_rng(0)
    angle = np.pi - short_of_half_a_turn
    axes = [*np.eye(3), *-np.eye(3), *random.standard_normal((50, 3))]
    for axis in axes:
        turn = angle * axis / np.linalg.norm(axis)
        reference = Reference(np.zeros(3), pin.exp3(random.standard_normal(3)), np.zeros(ARM.n))
        error = pose_error(np.zeros(3), pin.exp3(turn) @ reference.rotation, reference)[3:]
        # Half a turn to the one side and to the other are the same.
        miss = min(np.abs(error - turn).max(), np.abs(error + turn).max() if short_of_half_a_turn < 1e-7 else np.inf)
        assert miss < 1e-7


small = st.floats(-1.5, 1.5)
vectors = st.tuples(small, small, small).map(np.array)


@given(vectors, vectors, vectors)
def test_pose_error_leads_back_to_the_pose(translation, turn, base_turn):
    reference = Reference(np.array([0.4, 0.1, 0.3]), pin.exp3(base_turn), np.zeros(ARM.n))
    rotation = pin.exp3(turn) @ reference.rotation
    error = pose_error(reference.position + translation, rotation, reference)
    np.testing.assert_allclose(error[:3], translation, rtol=0, atol=1e-12)
    np.testing.assert_allclose(pin.exp3(error[3:]) @ reference.rotation, rotation, rtol=0, atol=1e-9)
