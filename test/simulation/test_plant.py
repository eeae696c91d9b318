"""The simulated robot at rest, braked, commanded and wrong."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TORQUE_LIMITS, ideal_plant, random_states

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.simulation.plant import (
    FRICTION,
    POSITION_NOISE,
    POSITION_RESOLUTION,
    TICK,
    TORQUE_NOISE,
    VELOCITY_NOISE,
    Actuation,
    Plant,
)
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings, Scene


def run(plant: Plant, seconds: float, command: np.ndarray | None = None) -> None:
    for _ in range(round(seconds / TICK)):
        plant.step(command)


def test_brakes_hold_the_arm_from_the_first_step_on():
    for q in 0.9 * random_states(3)[0]:
        plant = ideal_plant(q, friction=FRICTION, mismatch=MismatchSettings())
        assert plant.actuation is Actuation.BRAKED
        run(plant, 0.5)
        assert np.abs(plant.data.qpos - q).max() < 1e-9


def test_commanded_torque_moves_the_arm_as_the_model_says():
    plant, model = ideal_plant(), RobotModel(ARM)
    plant.step()
    plant.set_actuation(Actuation.COMMANDED)
    random = np.random.default_rng(0)
    for _ in range(100):
        q, v = plant.data.qpos.copy(), plant.data.qvel.copy()
        model.update(q, v)
        command = model.gravity + random.uniform(-5, 5, 7)
        acceleration = np.linalg.solve(model.mass_matrix, command - model.bias)
        plant.step(command)
        np.testing.assert_allclose(plant.data.qvel, v + TICK * acceleration, rtol=0, atol=1e-9)
        np.testing.assert_allclose(plant.data.qpos, q + TICK * plant.data.qvel, rtol=0, atol=1e-12)


def test_commands_are_capped_at_the_data_sheets_limits():
    plants = [ideal_plant(), ideal_plant()]
    for plant, command in zip(plants, (1e6 * np.ones(7), TORQUE_LIMITS), strict=True):
        plant.set_actuation(Actuation.COMMANDED)
        run(plant, 0.02, command)
    np.testing.assert_array_equal(plants[0].data.qpos, plants[1].data.qpos)
    np.testing.assert_array_equal(plants[0].read().torque, TORQUE_LIMITS)


class TestMismatch:
    def test_model_error_is_as_large_as_the_inertia_sets_differ(self):
        plant = ideal_plant(mismatch=MismatchSettings(payload=0.0))
        others = dataclasses.replace(ARM, inertia_sets={"nominal": ARM.inertias("alternative")})
        true = RobotModel(others).gravity_at(HOME)
        np.testing.assert_allclose(plant.data.qfrc_bias, true, rtol=0, atol=1e-9)
        assert np.abs(true - RobotModel(ARM).gravity_at(HOME)).max() > 1.0

    def test_payload_pulls_the_flange_down(self):
        payload = 2.0
        with_payload, without = (ideal_plant(mismatch=MismatchSettings(payload=mass)) for mass in (payload, 0.0))
        model = RobotModel(ARM)
        model.update(HOME, REST)
        # The payload hangs 5 cm in front of the flange.
        lever = model.rotation @ (0.0, 0.0, 0.05)
        force = np.array([0.0, 0.0, payload * 9.81])
        expected = model.jacobian.T @ np.concatenate([force, np.cross(lever, force)])
        difference = with_payload.data.qfrc_bias - without.data.qfrc_bias
        np.testing.assert_allclose(difference, expected, rtol=0, atol=1e-9)

    def test_friction_is_scaled(self):
        plant = ideal_plant(friction=(0.5, 0.1), mismatch=MismatchSettings(friction_scale=5.0))
        plant.set_actuation(Actuation.COMMANDED)
        np.testing.assert_allclose(plant.model.dof_damping, 2.5)
        np.testing.assert_allclose(plant.model.dof_frictionloss, 0.5)


class TestSensors:
    @pytest.mark.parametrize("scale", [1.0, 4.0])
    def test_noise_has_the_spread_of_the_scene_and_no_offset(self, scale):
        plant = ideal_plant(mismatch=dataclasses.replace(NO_MISMATCH, noise_scale=scale))
        plant.set_actuation(Actuation.COMMANDED)
        command = RobotModel(ARM).gravity_at(HOME)
        plant.step(command)
        readings = [plant.read() for _ in range(3000)]
        for name, true, spread in (
            ("q", plant.data.qpos, np.hypot(scale * POSITION_NOISE, POSITION_RESOLUTION / np.sqrt(12))),
            ("v", plant.data.qvel, scale * VELOCITY_NOISE),
            ("torque", command, scale * TORQUE_NOISE),
        ):
            errors = np.array([getattr(reading, name) for reading in readings]) - true
            assert np.std(errors) == pytest.approx(spread, rel=0.05), name
            assert np.abs(errors.mean(axis=0)).max() < 0.1 * spread, name
            assert np.abs(np.corrcoef(errors.T) - np.eye(ARM.n)).max() < 0.1, name

    def test_joints_that_are_slow_to_move_their_arm_have_less_noise_of_velocity(self):
        joints = tuple(dataclasses.replace(joint, torque_limit=0.1 * joint.torque_limit) for joint in ARM.joints)
        arm = dataclasses.replace(ARM, joints=joints)
        plant = Plant(Scene("test", arm, 0, HOME, np.zeros(3), (), mismatch=NO_MISMATCH), FRICTION)
        spread = np.std([plant.read().v for _ in range(3000)], axis=0)
        model = RobotModel(arm)
        model.update(HOME, REST)
        # In the observer's estimate, whose gain is 50 1/s.
        noise = 50.0 * TICK * np.linalg.norm(model.mass_matrix, axis=1) * spread
        assert (noise < 1.4e-3 * arm.torque_limits).all() and spread[1] < 0.3 * VELOCITY_NOISE
        assert spread[6] == pytest.approx(VELOCITY_NOISE, rel=0.05)

    def test_torque_is_unknown_unless_commanded(self):
        plant = ideal_plant()
        for actuation in (Actuation.COMMANDED, Actuation.DAMPED_HOLD, Actuation.BRAKED):
            plant.set_actuation(actuation)
            plant.step(REST)
            reading = plant.read()
            assert np.isfinite(reading.torque).all() == (actuation is Actuation.COMMANDED)
            assert np.isfinite([reading.q, reading.v]).all()
