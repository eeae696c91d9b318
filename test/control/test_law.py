"""The laws (1)-(3) and (6): what the torques do to the arm, also near singularities."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME, REST, mobility, random_states
from hypothesis import given
from hypothesis import strategies as st
from six_axis import SIX_AXIS

from benchmarks.law import ImpedanceLaw, pose_error
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.kernels import solve_bounded
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import SINGULARITY_FLOOR, ImpedanceSettings

SETTINGS = ImpedanceSettings()


def reference_at(model: RobotModel, q: np.ndarray) -> Reference:
    return Reference(*model.tip_pose(q), q)


def law_torque(law: ImpedanceLaw, model: RobotModel, q: np.ndarray, v: np.ndarray, reference: Reference) -> np.ndarray:
    """τ of law (3) without C + g; the model is updated."""
    model.update(q, v)
    return law.torque(model, v, q - reference.posture, pose_error(model.position, model.rotation, reference))


@pytest.mark.parametrize("arm", [ARM, SIX_AXIS], ids=lambda arm: arm.name)
@pytest.mark.parametrize("task", ["position", "position_and_axis"])
def test_a_task_of_fewer_rows_moves_the_tip_as_asked_and_leaves_the_other_turns_to_law_two(arm, task):
    model, random = RobotModel(arm), np.random.default_rng(4)
    settings = ImpedanceSettings(task=task)
    law = ImpedanceLaw(arm, settings)
    for _ in range(50):
        q, v = random.uniform(arm.lower, arm.upper), random.normal(0.0, 0.5, arm.n)
        model.update(q, v)
        z = model.rotation[:, 2]
        has_axis = task == "position_and_axis"
        rows = np.concatenate([model.jacobian[:3], model.rotation.T[: 2 * has_axis] @ model.jacobian[3:]])
        if np.linalg.eigvalsh(rows @ np.linalg.solve(model.mass_matrix, rows.T))[0] < SINGULARITY_FLOOR:
            continue
        # However the reference is turned about its axis.
        about, tilt = pin.exp3(random.uniform(-3.0, 3.0) * z), pin.exp3(random.uniform(-0.5, 0.5, 3))
        reference = Reference(model.position - 0.1, tilt @ about @ model.rotation, q)
        error = pose_error(model.position, model.rotation, reference, task)
        torques = [law.torque(model, v, posture, error) for posture in random.uniform(-1.0, 1.0, (2, arm.n))]
        accelerations = [np.linalg.solve(model.mass_matrix, torque) for torque in torques]
        wanted = -settings.task_stiffness * error - settings.task_damping * model.twist
        for acceleration in accelerations:
            twist = model.jacobian @ acceleration + model.drift
            np.testing.assert_allclose(twist[:3], wanted[:3], rtol=0, atol=1e-8)
            if has_axis:
                # ω × ż is what turns the axis although nothing accelerates.
                np.testing.assert_allclose(np.cross(twist[3:], z), np.cross(wanted[3:], z), rtol=0, atol=1e-8)
        if has_axis:
            np.testing.assert_allclose(pin.exp3(error[3:]) @ reference.rotation[:, 2], z, rtol=0, atol=1e-9)
            assert abs(error[3:] @ z) < 1e-9
        assert abs(z @ model.jacobian[3:] @ (accelerations[1] - accelerations[0])) > 0.01


def test_law_is_the_sum_of_the_papers_terms():
    model, law = RobotModel(ARM), ImpedanceLaw(ARM, SETTINGS)
    reference = reference_at(model, HOME)
    for q, v in zip(*random_states(100), strict=True):
        torque = law_torque(law, model, q, v, reference)
        if np.linalg.eigvalsh(mobility(model))[0] < SINGULARITY_FLOOR:
            continue
        error = pose_error(model.position, model.rotation, reference)
        command = -SETTINGS.task_stiffness * error - SETTINGS.task_damping * model.twist - model.drift
        posture = -SETTINGS.null_stiffness * (q - reference.posture) - SETTINGS.null_damping * v
        expected = model.jacobian.T @ np.linalg.inv(mobility(model)) @ command
        # What the posture does to the tip is taken out again.
        moved = mobility(model), model.jacobian @ np.linalg.solve(model.mass_matrix, posture)
        expected += posture - model.jacobian.T @ np.linalg.solve(*moved)
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


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi - 0.1, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12, np.pi])
def test_pose_error_leads_back_to_the_pose_up_to_half_a_turn(angle):
    random = np.random.default_rng(0)
    for axis in (*np.eye(3), *-np.eye(3), *random.standard_normal((50, 3))):
        turn = angle * axis / np.linalg.norm(axis)
        reference = Reference(random.standard_normal(3), pin.exp3(random.standard_normal(3)), np.zeros(ARM.n))
        shift = random.standard_normal(3)
        error = pose_error(reference.position + shift, pin.exp3(turn) @ reference.rotation, reference)
        np.testing.assert_allclose(error[:3], shift, rtol=0, atol=1e-12)
        # Half a turn to the one side and to the other are the same.
        miss = min(np.abs(error[3:] - turn).max(), np.abs(error[3:] + turn).max() if np.pi - angle < 1e-7 else np.inf)
        assert miss < 1e-7


SINGULAR = {
    "stretched upwards": np.zeros(ARM.n),
    "stretched forwards": np.array([0.0, np.pi / 4, 0.0, 0.0, 0.0, np.pi / 4, 0.0]),
    "shoulder": np.array([0.3, 0.0, np.pi / 2, -1.2, 0.4, 0.8, 0.1]),
    "wrist": np.array([0.3, 0.6, 0.2, -1.2, np.pi / 2, 0.0, 0.1]),
    "shoulder and wrist": np.array([0.3, 0.0, 0.2, -1.2, 0.4, 0.0, 0.1]),
}


@pytest.mark.parametrize("singular", SINGULAR.values(), ids=SINGULAR)
def test_torques_change_smoothly_along_a_path_through_a_singularity(singular):
    model, law, random = RobotModel(ARM), ImpedanceLaw(ARM, SETTINGS), np.random.default_rng(1)
    direction, v = random.standard_normal(ARM.n), 0.1 * random.standard_normal(ARM.n)
    direction /= np.linalg.norm(direction)
    position, rotation = model.tip_pose(singular)
    pulled = Reference(position + np.array([0.006, 0.005, -0.006]), rotation, singular + 0.2)

    def largest_change(count: int) -> float:
        path = [singular + share * direction for share in np.linspace(-0.05, 0.05, count + 1)]
        torques = np.array([law_torque(law, model, q, v, pulled) for q in path])
        return float(np.abs(np.diff(torques, axis=0)).max())

    # A jump would stay as large; what is continuous changes half as much over half the distance.
    coarse, fine = largest_change(200), largest_change(400)
    assert fine == pytest.approx(0.5 * coarse, rel=0.1)


@given(st.lists(st.floats(0.0, 5.0), min_size=6, max_size=6).map(np.array), st.integers(0, 1000))
def test_the_inverse_is_bounded_and_never_asks_for_more_than_the_true_one(eigenvalues, seed):
    def bounded_inverse(matrix: np.ndarray) -> np.ndarray:
        return solve_bounded(matrix, np.eye(6), SINGULARITY_FLOOR).T

    vectors = np.linalg.qr(np.random.default_rng(seed).standard_normal((6, 6)))[0]
    matrix = (vectors * eigenvalues) @ vectors.T
    inverse = bounded_inverse(matrix)
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-9)
    assert np.linalg.norm(inverse, 2) <= 2.0 / SINGULARITY_FLOOR * (1 + 1e-9)
    # Λ_bounded (J M⁻¹ Jᵀ) has eigenvalues in [0, 1]: an acceleration may fall short, never overshoot.
    share = np.linalg.eigvals(inverse @ matrix)
    np.testing.assert_allclose(share.imag, 0, atol=1e-9)
    assert share.real.min() >= -1e-9 and share.real.max() <= 1 + 1e-9
    above = (vectors * (eigenvalues + SINGULARITY_FLOOR)) @ vectors.T
    np.testing.assert_allclose(bounded_inverse(above) @ above, np.eye(6), rtol=0, atol=1e-10)
