"""Which contacts known obstacles explain: torques of pushes in the simulated arm, located as the observer does it."""

import functools

import mujoco
import numpy as np
import pytest
from arm_simulation import ARM, HOME, ideal_plant
from plans import StayingCore
from test_planner import GOAL, make, state

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import Contact, ContactLocator
from contact_reach_ros.observer.observer import EXCESS_FORCE
from contact_reach_ros.planning.unexpected_contact import Explanation
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.spheres import Spheres

BUDGET = ContactBudget()
LOCATOR = ContactLocator(RobotModel(ARM), BUDGET.resolve(ARM).contact_thresholds)
EXPLANATION = Explanation(ARM, BUDGET)
CAPSULES = ELBOW, FOREARM, WRIST, HAND = (2, 3, 4, 5)
AHEAD, SIDEWAYS, UP = np.eye(3)
plant = functools.cache(ideal_plant)


def middle(capsule: int, q: np.ndarray) -> np.ndarray:
    return np.mean(capsule_segments(ARM, q), axis=0)[capsule]


def push(capsule: int, force: np.ndarray, q: np.ndarray = HOME) -> np.ndarray:
    """Torques (7,), N m, of a force (3,), N, through the middle of a capsule, according to the simulation."""
    simulated: Plant = plant()
    model, data, torque = simulated.model, simulated.data, np.zeros(ARM.n)
    data.qpos[: ARM.n] = q
    mujoco.mj_forward(model, data)
    body = model.body(ARM.link_names[ARM.capsules[capsule].link - 1]).id
    mujoco.mj_applyFT(model, data, force, np.zeros(3), middle(capsule, q), body, torque)
    return torque


def located(torque: np.ndarray, q: np.ndarray = HOME) -> Contact:
    return LOCATOR.locate(q, torque).rounded()


def ball(
    capsule: int, normal: np.ndarray, gap: float = 0.0, q: np.ndarray = HOME, error: np.ndarray | float = 0.0
) -> Spheres:
    """A known one that would push a capsule along `normal`, `gap` m from its surface, and misplaced by `error`, m."""
    radius = 0.06
    center = (middle(capsule, q) - (ARM.capsules[capsule].radius + radius + gap) * normal + error)[None]
    return Spheres(center, center, np.array([radius]), np.array([100.0]), np.array([30.0]))


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("capsule", CAPSULES)
def test_a_permitted_force_of_a_known_ball_is_explained_although_it_is_1_cm_misplaced(capsule):
    random = np.random.default_rng(capsule)
    for _ in range(100):
        q = HOME + random.uniform(-0.6, 0.6, ARM.n)
        starts, ends = capsule_segments(ARM, q)
        normal = unit(np.cross((ends - starts)[capsule], random.standard_normal(3)))
        touched = ball(capsule, normal, 0.0, q, 0.01 * unit(random.standard_normal(3)))
        for force in (8.0, BUDGET.permitted_force):
            assert EXPLANATION.unexpected(located(push(capsule, force * normal, q), q), q, touched) is None


def test_known_balls_on_all_sides_explain_permitted_forces_of_two_of_them_with_an_error_of_the_model():
    """As between walls: great forces that cancel each other would fit the error, too, but are not permitted."""
    random, sides = np.random.default_rng(0), (SIDEWAYS, -SIDEWAYS, UP, -UP)
    centers = np.concatenate([ball(capsule, side).center for capsule in CAPSULES for side in sides])
    radius, stiffness, damping = (np.full(len(centers), value) for value in (0.06, 100.0, 30.0))
    around = Spheres(centers, centers, radius, stiffness, damping)
    for _ in range(50):
        pushed = sum(push(int(random.choice(CAPSULES)), 4.0 * sides[random.integers(4)]) for _ in range(2))
        error = random.uniform(-0.5, 0.5, ARM.n) * BUDGET.resolve(ARM).contact_thresholds
        assert EXPLANATION.unexpected(located(pushed + error), HOME, around) is None


@pytest.mark.parametrize("capsule", CAPSULES)
def test_of_a_stronger_one_what_is_beyond_the_permitted_force_is_left(capsule):
    left = EXPLANATION.unexpected(located(push(capsule, 20.0 * SIDEWAYS)), HOME, ball(capsule, SIDEWAYS))
    assert left.strength == pytest.approx(20.0 - BUDGET.permitted_force - EXCESS_FORCE, abs=0.1)


@pytest.mark.parametrize("direction", [-SIDEWAYS, AHEAD, -AHEAD])
def test_a_known_ball_at_the_elbow_explains_no_contact_of_the_hand(direction):
    contact = located(push(HAND, 8.0 * direction))
    assert EXPLANATION.unexpected(contact, HOME, ball(ELBOW, SIDEWAYS, 0.01)) is not None


@pytest.mark.parametrize("direction", [SIDEWAYS, -SIDEWAYS, AHEAD, -AHEAD, UP])
def test_an_unknown_contact_beside_a_known_one_is_left(direction):
    both = located(push(ELBOW, 10.0 * SIDEWAYS) + push(HAND, 10.0 * direction))
    left = EXPLANATION.unexpected(both, HOME, ball(ELBOW, SIDEWAYS))
    assert left is not None and left.strength > 5.0


def test_a_known_ball_explains_from_one_side_only_and_no_farther_than_it_may_be_misplaced():
    contact = located(push(HAND, 8.0 * SIDEWAYS))
    assert EXPLANATION.unexpected(contact, HOME, ball(HAND, SIDEWAYS, 0.019)) is None
    for other in (ball(HAND, SIDEWAYS, 0.03), ball(HAND, -SIDEWAYS), Spheres.none()):
        assert EXPLANATION.unexpected(contact, HOME, other) is not None


def test_weak_contact_is_no_reason_and_one_of_an_old_bag_without_torques_is_never_explained():
    assert EXPLANATION.unexpected(located(push(HAND, 4.5 * SIDEWAYS)), HOME, Spheres.none()) is None
    old = Contact(ARM.link_names[-1], middle(HAND, HOME), 8.0 * SIDEWAYS, np.full(ARM.n, np.nan))
    assert EXPLANATION.unexpected(old, HOME, ball(HAND, SIDEWAYS)) is old


def test_a_planner_explains_by_the_obstacles_that_it_saw_last():
    planner, contact = make(StayingCore()), located(push(HAND, 8.0 * SIDEWAYS))
    planner.see(ball(HAND, SIDEWAYS))
    planner.request(state(0))
    planner.command(GOAL)
    for tick in range(200):
        planner.request(state(tick))
        assert not planner.objection(contact)
    planner.see(Spheres.none())
    found = []
    for tick in range(200, 212):
        planner.request(state(tick))
        found.append(planner.objection(contact))
    assert found[0] == "" and found[-1].startswith("unexpected contact of 8 N at lbr_link_7")
