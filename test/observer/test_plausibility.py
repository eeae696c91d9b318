"""Joint states that cannot be true are noticed, and true ones are not doubted."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, SECOND_NS, TICK_NS

from contact_reach_ros.arm import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import StopCode
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.plausibility import FROZEN_TIME, PlausibilityCheck, PlausibilitySettings, TorqueCheck
from contact_reach_ros.observer.settings import ObserverSettings

SETTINGS = PlausibilitySettings()
THRESHOLDS = ContactBudget().resolve(ARM).contact_thresholds
TOUCHED = 1.1 * np.array(THRESHOLDS)


class MovingArm:
    """Joints on sine curves, as noisy sensors tell them."""

    def __init__(self, speed: float, noise: float = 1.0, period_ms: int = 1) -> None:
        self.check = PlausibilityCheck(ARM, SETTINGS, THRESHOLDS, 0.001 * period_ms)
        self.period_ms = period_ms
        self.random = np.random.default_rng(0)
        self.speed, self.noise = speed, noise
        self.tick, self.stamp_ns = 0, 0

    def read(self, ticks: int = 0) -> tuple[np.ndarray, np.ndarray]:
        ticks = ticks or self.period_ms
        self.tick += ticks
        self.stamp_ns += ticks * TICK_NS
        phase = 4.0 * self.tick * 1e-3 + np.arange(ARM.n)
        noise = self.noise * self.random.standard_normal((2, ARM.n))
        q = HOME + self.speed / 4.0 * np.sin(phase) + 1e-5 * noise[0]
        return q, self.speed * np.cos(phase) + 1e-3 * noise[1]


@pytest.mark.parametrize("speed", [0.0, 0.1, 2.0])
def test_an_arm_with_noise_is_believed_even_in_contact(speed):
    arm = MovingArm(speed)
    for _ in range(3000):
        assert not arm.check.update(*arm.read(), None, TOUCHED, arm.stamp_ns)


def test_gaps_jumps_of_the_clock_and_unknown_torques_are_no_reason():
    arm = MovingArm(2.0)
    for number in range(600):
        q, v = arm.read(ticks=30 if number % 50 == 0 else 1 + number % 3)
        arm.stamp_ns += (number == 300) * SECOND_NS - (number == 400) * SECOND_NS
        assert not arm.check.update(q, v, None, None, arm.stamp_ns)


@pytest.mark.parametrize(("joint", "period_ms", "latest"), [(0, 1, 70), (6, 5, 75)])
def test_a_stuck_position_of_a_moving_joint_whose_speed_is_reported_is_named_at_every_rate(joint, period_ms, latest):
    arm = MovingArm(0.5, period_ms=period_ms)
    stuck = arm.read()[0][joint]
    for _ in range(500):
        q, v = arm.read()
        q[joint], v[joint] = stuck, 0.4
        wrong = arm.check.update(q, v, None, REST, arm.stamp_ns)
        if wrong:
            break
    assert wrong.startswith(f"position and velocity of lbr_A{joint + 1} differ by -0.02")
    # 0.02 rad at 0.4 rad/s are 50 ms.
    assert arm.tick < latest


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_joint_that_stays_while_torque_acts_on_it_is_named(noise):
    arm = MovingArm(0.5, noise)
    for number in range(2 * FROZEN_TIME):
        q, v = arm.read()
        q[3], v[3] = HOME[3], 0.0
        wrong = arm.check.update(q, v, None, TOUCHED, arm.stamp_ns)
        assert bool(wrong) == (number >= FROZEN_TIME)
    assert wrong.startswith("the position of lbr_A4 has not changed for ")


class TestStuckTorque:
    """A measured torque that stays the same while its joint moves."""

    MOVING = np.where(np.arange(ARM.n) == 2, 0.1, 0.0)

    def states(self, torques, v, period=0.001):
        check = TorqueCheck(ARM, period)
        return [check.update(HOME + period * tick * v, torque) for tick, torque in enumerate(torques)]

    @pytest.mark.parametrize("period", [0.001, 0.005])
    def test_it_is_noticed_after_its_time_and_the_joint_is_named(self, period):
        states = round(0.2 / period)
        found = self.states([np.full(ARM.n, 3.0)] * (states + 1), self.MOVING, period)
        assert found[:-1] == [""] * states
        assert f"the torque of {ARM.joint_names[2]} has been 3.00 Nm for {states} states" in found[-1]
        assert found[-1].code is StopCode.TORQUE_SENSOR

    def test_an_arm_at_rest_may_have_constant_torques(self):
        assert not any(self.states([np.full(ARM.n, 3.0)] * 1000, np.full(ARM.n, 0.0029)))

    def test_a_joint_that_is_pushed_away_slowly_shows_it(self):
        assert any(self.states([np.full(ARM.n, 3.0)] * 1000, np.full(ARM.n, 0.0031)))

    def test_one_that_moves_to_and_fro_does_not(self):
        check = TorqueCheck(ARM)
        there = HOME + 0.002
        assert not any(check.update(HOME if tick % 2 else there, np.full(ARM.n, 3.0)) for tick in range(1000))

    def test_the_observer_stops_for_it(self):
        observer, torque = Observer(ARM, ObserverSettings(), ContactBudget()), RobotModel(ARM).gravity_at(HOME)
        for tick in range(1, 260):
            q = HOME + 0.001 * tick * self.MOVING
            report = observer.update(JointState(tick * 1_000_000, q, self.MOVING, torque))
        assert "look at its torque sensor" in report.verdict.reason and not report.verdict.distrust
