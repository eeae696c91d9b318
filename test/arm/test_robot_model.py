"""Derivatives of the Pinocchio model against finite differences, and what `update` promises."""

import locale
import subprocess

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME, REST, random_states

from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel

STEP = 1e-6


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel(ARM)


def finite_difference_twist(model: RobotModel, q: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Change of the flange pose along a change of the joints, central difference."""
    ahead, ahead_rotation = model.tip_pose(q + STEP * change)
    behind, behind_rotation = model.tip_pose(q - STEP * change)
    return np.concatenate([ahead - behind, pin.log3(ahead_rotation @ behind_rotation.T)]) / (2 * STEP)


def test_jacobian_is_the_derivative_of_the_tip_pose(model):
    for q, v in zip(*random_states(50), strict=True):
        model.update(q, v)
        jacobian = np.array([finite_difference_twist(model, q, column) for column in np.eye(ARM.n)]).T
        np.testing.assert_allclose(model.jacobian, jacobian, rtol=0, atol=1e-8)
        np.testing.assert_allclose(model.twist, finite_difference_twist(model, q, v), rtol=0, atol=1e-8)


def test_drift_is_the_derivative_of_the_twist_at_constant_joint_velocity(model):
    for q, v in zip(*random_states(50), strict=True):
        model.update(q + STEP * v, v)
        ahead = model.twist
        model.update(q - STEP * v, v)
        behind = model.twist
        model.update(q, v)
        np.testing.assert_allclose(model.drift, (ahead - behind) / (2 * STEP), rtol=0, atol=1e-7)


def test_coriolis_matrix_gives_bias_and_derivative_of_the_mass_matrix(model):
    for q, v in zip(*random_states(20), strict=True):
        model.update(q + STEP * v, v)
        ahead = model.mass_matrix.copy()
        model.update(q - STEP * v, v)
        behind = model.mass_matrix.copy()
        model.update(q, v)
        coriolis = model.coriolis_matrix(q, v)
        np.testing.assert_allclose(coriolis @ v + model.gravity, model.bias, rtol=0, atol=1e-11)
        np.testing.assert_allclose(coriolis + coriolis.T, (ahead - behind) / (2 * STEP), rtol=0, atol=1e-7)


def test_looking_elsewhere_leaves_the_attributes_alone(model):
    model.update(HOME, 0.1 * np.ones(7))
    names = ("mass_matrix", "bias", "gravity", "position", "rotation", "jacobian", "twist", "drift")
    before = {name: getattr(model, name).copy() for name in names}
    model.gravity_at(REST)
    model.tip_pose(REST)
    model.coriolis_matrix(HOME, 0.1 * np.ones(7))
    for name in names:
        np.testing.assert_array_equal(getattr(model, name), before[name], err_msg=name)


@pytest.fixture
def decimal_comma(tmp_path, monkeypatch):
    """As in a program that uses the user's language, with Qt or matplotlib."""
    (tmp_path / "source").write_text('LC_NUMERIC\ndecimal_point ","\nthousands_sep "."\ngrouping 3\nEND LC_NUMERIC\n')
    command = ["localedef", "-c", "-i", tmp_path / "source", "-f", "ANSI_X3.4-1968", tmp_path / "comma"]
    subprocess.run(command, capture_output=True, check=False)
    monkeypatch.setenv("LOCPATH", str(tmp_path))
    before = locale.setlocale(locale.LC_NUMERIC)
    locale.setlocale(locale.LC_NUMERIC, "comma")
    yield
    locale.setlocale(locale.LC_NUMERIC, before)


def test_a_decimal_comma_changes_no_model(model, decimal_comma):
    assert locale.localeconv()["decimal_point"] == ","
    expected = model.gravity_at(HOME)
    np.testing.assert_array_equal(RobotModel(ARM).gravity_at(HOME), expected)
    simulated = mujoco.MjModel.from_xml_string(build_mjcf(ARM))
    data = mujoco.MjData(simulated)
    data.qpos[:] = HOME
    mujoco.mj_forward(simulated, data)
    np.testing.assert_allclose(data.qfrc_bias, expected, atol=1e-6)
