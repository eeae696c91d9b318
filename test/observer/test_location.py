"""Which link is touched: fits to torques of pushes at random places, and in the simulated arm."""

import mujoco
import numpy as np
import pytest
from arm_simulation import ARM, HOME, ideal_plant

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import ContactLocator

SCALES = ContactBudget().resolve(ARM).contact_thresholds
RANGE = np.array([1.2, 0.5, 0.8, 0.6, 1.2, 0.6, 1.5])
MID_ARM = (3, 4, 5)


@pytest.fixture(scope="module")
def locator() -> ContactLocator:
    return ContactLocator(RobotModel(ARM), SCALES)


class Pushes:
    """Forces across random links at random places and postures, and the torques that the simulation says they cause."""

    def __init__(self, links: tuple[int, ...], seed: int = 0) -> None:
        self._random = np.random.default_rng(seed)
        self._plant = ideal_plant()
        self._capsules = [capsule for capsule in ARM.capsules if capsule.link in links]

    def draw(self, strength: float = 50.0) -> tuple[np.ndarray, str, np.ndarray, np.ndarray, np.ndarray]:
        """Joint angles (7,), link, point (3,), force (3,), torques (7,)."""
        random, model, data = self._random, self._plant.model, self._plant.data
        q = HOME + random.uniform(-RANGE, RANGE)
        data.qpos[: ARM.n] = q
        mujoco.mj_forward(model, data)
        capsule = self._capsules[random.integers(len(self._capsules))]
        link = ARM.link_names[capsule.link - 1]
        body = model.body(link).id
        rotation = data.xmat[body].reshape(3, 3)
        start, end = np.array(capsule.start), np.array(capsule.end)
        point = data.xpos[body] + rotation @ (start + random.uniform() * (end - start))
        along = rotation @ (end - start) / np.linalg.norm(end - start)
        force = random.standard_normal(3)
        force -= along * (force @ along)
        force *= strength / np.linalg.norm(force)
        torque = np.zeros(ARM.n)
        mujoco.mj_applyFT(model, data, force, np.zeros(3), point, body, torque)
        return q, link, point, force, torque


def test_link_of_most_pushes_at_mid_arm_is_right(locator):
    pushes, random, right, errors = Pushes(MID_ARM), np.random.default_rng(1), [], []
    for _ in range(400):
        q, link, _, force, torque = pushes.draw()
        contact = locator.locate(q, torque + 0.25 * np.array(SCALES) * random.standard_normal(ARM.n))
        right.append(contact.link == link)
        errors.append(np.linalg.norm(contact.force - force) / np.linalg.norm(force))
    assert np.mean(right) > 0.8
    assert np.median(errors) < 0.2


def test_the_least_force_is_above_the_permitted_one_for_strong_pushes_and_below_it_for_weak_ones(locator):
    """Errors of a third of a threshold on each joint, which at short levers look like tens of newtons."""
    random, weak, strong, taken = np.random.default_rng(2), Pushes(MID_ARM), Pushes(MID_ARM, seed=1), []
    for _ in range(300):
        errors = 0.3 * np.array(SCALES) * random.standard_normal(ARM.n)
        q, _, _, _, torque = weak.draw(8.0)
        contact = locator.locate(q, torque + errors)
        assert contact.least <= contact.strength + 1e-9
        q, _, _, _, torque = strong.draw(40.0)
        taken.append((contact.strength, contact.least, locator.locate(q, torque + errors).least))
    best, least, of_strong = (np.array(taken) > 13.0).mean(axis=0)
    assert best > 0.03
    assert least < 0.5 * best
    assert of_strong > 0.95


def test_estimate_is_finite_where_the_arm_is_singular(locator):
    contact = locator.locate(np.zeros(ARM.n), np.full(ARM.n, 5.0))
    assert np.isfinite([*contact.force, *contact.position]).all()
