"""Joint states that cannot be true are noticed, and true ones are not doubted."""

import numpy as np
import pytest
from arm_simulation import HOME, REST, SECOND_NS, TICK_NS

from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.plausibility import PlausibilityCheck, PlausibilitySettings

SETTINGS = PlausibilitySettings()
THRESHOLDS = ContactBudget().contact_thresholds
TOUCHED = 1.1 * np.array(THRESHOLDS)


class Arm:
    """Joints on sine curves, as noisy sensors tell them."""

    def __init__(self, speed: float, noise: float = 1.0) -> None:
        self.check = PlausibilityCheck(SETTINGS, THRESHOLDS)
        self.random = np.random.default_rng(0)
        self.speed, self.noise = speed, noise
        self.tick, self.stamp_ns = 0, 0

    def read(self, ticks: int = 1) -> tuple[np.ndarray, np.ndarray]:
        self.tick += ticks
        self.stamp_ns += ticks * TICK_NS
        phase = 4.0 * self.tick * 1e-3 + np.arange(7)
        noise = self.noise * self.random.standard_normal((2, 7))
        q = HOME + self.speed / 4.0 * np.sin(phase) + 1e-5 * noise[0]
        return q, self.speed * np.cos(phase) + 1e-3 * noise[1]


@pytest.mark.parametrize("speed", [0.0, 0.1, 2.0])
def test_an_arm_with_noise_is_believed_even_in_contact(speed):
    arm = Arm(speed)
    for _ in range(3000):
        assert not arm.check.update(*arm.read(), TOUCHED, arm.stamp_ns)


def test_gaps_jumps_of_the_clock_and_unknown_torques_are_no_reason():
    arm = Arm(2.0)
    for number in range(600):
        q, v = arm.read(ticks=30 if number % 50 == 0 else 1 + number % 3)
        arm.stamp_ns += (number == 300) * SECOND_NS - (number == 400) * SECOND_NS
        assert not arm.check.update(q, v, None, arm.stamp_ns)


@pytest.mark.parametrize("joint", range(7))
def test_a_stuck_position_of_a_moving_joint_whose_speed_is_told_is_named(joint):
    arm = Arm(0.5)
    stuck = arm.read()[0][joint]
    for _ in range(500):
        q, v = arm.read()
        q[joint], v[joint] = stuck, 0.4
        wrong = arm.check.update(q, v, REST, arm.stamp_ns)
        if wrong:
            break
    assert wrong.startswith(f"position and velocity of lbr_A{joint + 1} differ by -0.02")
    # 0.02 rad at 0.4 rad/s are 50 ms.
    assert arm.tick < 70


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_joint_that_stays_while_torque_acts_on_it_is_named(noise):
    arm = Arm(0.5, noise)
    for number in range(2 * SETTINGS.frozen_states):
        q, v = arm.read()
        q[3], v[3] = HOME[3], 0.0
        wrong = arm.check.update(q, v, TOUCHED, arm.stamp_ns)
        assert bool(wrong) == (number >= SETTINGS.frozen_states)
    assert wrong.startswith("the position of lbr_A4 has not changed for ")


def test_a_resting_joint_that_its_encoder_tells_without_noise_is_believed_until_torque_acts_on_it():
    arm = Arm(0.0, noise=0.0)
    for _ in range(1000):
        assert not arm.check.update(*arm.read(), 0.9 * np.array(THRESHOLDS), arm.stamp_ns)
    assert "its encoder is stuck, or the joint blocked" in arm.check.update(*arm.read(), TOUCHED, arm.stamp_ns)
