"""The baseline of the external torque: it takes errors of the model, and no contact, however slowly that grows."""

import dataclasses
import itertools

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import mounted
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.observer.baseline import Baseline
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.safety import SafetyMonitor, SafetySettings

BUDGET = ContactBudget().resolve(ARM)
CONTACT = np.array(BUDGET.contact_thresholds)
MODEL = RobotModel(ARM)
PERIOD = 0.004
GAIN = 50.0


def make_baseline(model: RobotModel = MODEL) -> Baseline:
    return Baseline(model, BUDGET.handover_thresholds, 0.001)


def test_at_rest_it_takes_nothing():
    """An error of the model changes only with the posture: what changes at rest is contact."""
    baseline = make_baseline()
    baseline.restart(REST, HOME)
    for step in range(5000):
        baseline.follow(CONTACT, HOME + 1e-3 * np.sin(step), False)
    np.testing.assert_array_equal(baseline.mean, REST)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (0.035, -0.035, 0.0)], ids=["centred", "off centre"])
@pytest.mark.parametrize(
    "tilt", [(0.0, 0.0, 0.0), (3.1416, 0.0, 0.0), (0.9, 1.2, 0.0)], ids=["stands", "hangs", "leans"]
)
def test_it_takes_half_a_kilogram_and_a_tenth_of_gravity_wherever_the_arm_goes(seed, center, tilt):
    """The payload shows on A7, whose modelled gravity is nothing, too."""
    arm = dataclasses.replace(ARM, gravity=mounted(tilt))
    model, loaded = RobotModel(arm), RobotModel(arm.with_tool(Tool(mass=0.5, center=center)))
    random = np.random.default_rng(seed)
    scale = random.uniform(-0.1, 0.1, ARM.n)
    baseline, start = make_baseline(model), HOME + random.uniform(-0.3, 0.3, ARM.n)
    largest = np.zeros(ARM.n)
    end = HOME + random.uniform(-1.0, 1.0, ARM.n)
    for step in range(1500):
        q = start + min(step / 1000.0, 1.0) * (end - start)
        gravity = model.gravity_at(q)
        error = gravity - loaded.gravity_at(q) + scale * gravity
        if step == 0:
            first = error
        # At hand-over more than the limits was refused.
        error = error - first + np.clip(first, -1.0, 1.0)
        if step == 0:
            baseline.restart(error, q)
        baseline.follow(error, q, False)
        largest = np.maximum(largest, np.abs(error - baseline.mean))
    assert (largest < CONTACT).all()
    np.testing.assert_allclose(baseline.mean, error, atol=0.05)


def forces(rate: float, direction: np.ndarray, joint: int | None, seed: int) -> tuple[float, float]:
    """Forces at the tip, N, that are reported and that stop the arm, as one grows at `rate` N/s while a joint moves."""
    monitor = SafetyMonitor(MODEL, SafetySettings(), BUDGET, PERIOD)
    start = HOME + np.random.default_rng(seed).uniform(-0.4, 0.4, ARM.n)
    motion = np.zeros(ARM.n) if joint is None else 0.1 * np.eye(ARM.n)[joint]
    speed = 0.5
    reported, residual = np.nan, np.zeros(ARM.n)
    monitor.update(residual, start, REST, 0.0)
    for step in itertools.count():
        time = step * PERIOD
        q, v = start + motion * np.sin(speed * time), motion * speed * np.cos(speed * time)
        force = rate * max(time - 1.0, 0.0)
        external = MODEL.jacobian_at(q)[:3].T @ direction * force
        residual = residual + PERIOD * GAIN * (external - residual)
        monitor.update(residual, q, v)
        if monitor.in_contact and np.isnan(reported):
            reported = force
        if monitor.stopped:
            return reported, force
    raise AssertionError


@pytest.mark.parametrize("joint", [None, *range(ARM.n)])
@pytest.mark.parametrize("seed", [11, 12])
def test_a_force_that_grows_slowly_stops_the_arm_like_a_fast_one(joint, seed):
    """At rest and while any joint moves to and fro by 0.1 rad; 0.5 and 50 N/s."""
    direction = np.random.default_rng(100 + seed).standard_normal(3)
    direction /= np.linalg.norm(direction)
    slow, fast = (forces(rate, direction, joint, seed) for rate in (0.5, 50.0))
    assert slow[0] <= 1.1 * fast[0]
    assert slow[1] <= 1.1 * fast[1]


@pytest.mark.parametrize("joint", [0, 6])
def test_motion_that_changes_no_weight_explains_nothing(joint):
    """Turning A1 buys nothing; turning A7 what half a kilogram 5 cm off its axis weighs."""
    baseline = make_baseline()
    baseline.restart(REST, HOME)
    for step in range(3000):
        baseline.follow(np.full(ARM.n, 5.0), HOME + 1e-3 * step * np.eye(ARM.n)[joint], False)
    assert (np.array(baseline.mean) <= (0.5 if joint == 6 else 1e-9)).all()
