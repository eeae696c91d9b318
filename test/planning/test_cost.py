"""The cost (5): its parts, and its gradient."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, HOME, rotation_about
from planning_helpers import (
    FAR_BALL,
    FLANGE,
    LANES,
    PERMITTED_FORCE,
    ROTATIONS,
    SMALL,
    ball,
    beside_forearm,
    make_problem,
)

from benchmarks.authors_cost import AuthorsSettings
from contact_reach_ros.arm import link_frames
from contact_reach_ros.control.settings import IMPACT_ENERGY, LimitSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.lanes.compiled import Compiled
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.hybrid import slopes
from contact_reach_ros.planning.solver.solver import CostFunction
from contact_reach_ros.planning.terms import (
    JOINT_LIMIT_MARGIN,
    ROUNDING,
    TERMS,
    Context,
    Problem,
    Term,
    term,
    term_weights,
)
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.settings import setting

pytestmark = pytest.mark.usefixtures("quick_compilation")

STILL = np.zeros((3, 13, LANES))


def test_the_distance_from_the_goal_costs_and_moving_away_from_the_start_is_rewarded(roll_out):
    _, terms = roll_out(make_problem(HOME, FLANGE + np.array([0.3, 0.0, 0.4]), ball(FAR_BALL)), STILL)
    assert terms["goal"][0] == pytest.approx(3 * 0.5 * SMALL.goal_weight, abs=1e-3)
    assert abs(terms["progress"][0]) < 1e-3
    actions = STILL.copy()
    actions[:, 0, 0] = 0.01
    rollout, terms = roll_out(make_problem(HOME, FLANGE, ball(FAR_BALL)), actions)
    moved = np.linalg.norm(rollout.pose.position[1:, :, 0] - rollout.pose.position[0, :, 0], axis=1)
    assert terms["progress"][0] == pytest.approx(-SMALL.progress_weight * moved.sum(), abs=1e-3)
    assert terms["goal"][0] == pytest.approx(SMALL.goal_weight * moved.sum(), abs=1e-3)


def test_contact_costs_little_up_to_the_permitted_force_and_much_above(roll_out):
    for depth, over in ((0.005, False), (0.02, True)):
        rollout, terms = roll_out(make_problem(HOME, FLANGE, ball(beside_forearm(-depth))), STILL)
        force = np.asarray(rollout.contact[:, 0])
        assert (force.max() > PERMITTED_FORCE) == over
        excess = np.maximum(force - PERMITTED_FORCE, 0.0).sum()
        assert terms["contact_limit"][0] == pytest.approx(SMALL.contact_limit_weight * excess, rel=1e-4)
        assert terms["contact"][0] == pytest.approx(SMALL.contact_weight * force.sum(), rel=1e-4)


def test_all_links_together_may_press_as_hard_as_the_observer_permits_one(roll_out):
    rollout, _ = roll_out(make_problem(HOME, FLANGE, ball(FAR_BALL)), STILL)
    links = np.zeros(rollout.link_force.shape)
    for forces, beyond in (((9.0, 4.0), 0.0), ((8.0, 3.0, 4.0), 2.0), ((11.0,), 1.0)):
        links[0, : len(forces), 0] = forces
        pressing = rollout._replace(link_force=jnp.asarray(links), contact=jnp.asarray(links.max(axis=1)))
        problem = make_problem(HOME, FLANGE, ball(FAR_BALL))
        found = TERMS["contact_limit"].value(Context(None, 0.1, problem, STILL, pressing))
        assert found[0, 0] == pytest.approx(beyond) and not found[1:].any()
        links[:] = 0.0


def test_the_authors_terms_charge_the_end_of_the_plan_and_the_square_of_every_force(roll_out):
    actions = STILL.copy()
    actions[:, 0, 0] = 0.01
    problem = make_problem(HOME, FLANGE, ball(beside_forearm(-0.005)))
    problem = problem._replace(weights={"terminal": 2.0, "contact_squared": 0.5})
    rollout, terms = roll_out(problem, actions)
    assert terms.keys() == problem.weights.keys() < term_weights(AuthorsSettings()).keys()
    away = np.linalg.norm(rollout.pose.position[-1, :, 0] - rollout.pose.position[0, :, 0])
    assert terms["terminal"][0] == pytest.approx(2.0 * away, abs=1e-3) and away > 0.005
    assert terms["contact_squared"][0] == pytest.approx(0.5 * (rollout.link_force[..., 0] ** 2).sum(), rel=1e-4)
    assert terms["contact_squared"][0] > 0.1


def test_orientation_term_is_the_angle_and_counts_only_with_a_weight(roll_out):
    for angle in (0.1, 3.0):
        goal_rotation = rotation_about((0.0, 1.0, 0.0), angle) @ ROTATIONS[-1]
        problem = make_problem(HOME, FLANGE, ball(FAR_BALL), orientation=0.2)
        problem = problem._replace(goal_rotation=jnp.asarray(goal_rotation)[:, :, None])
        _, terms = roll_out(problem, STILL)
        expected = 0.2 * (np.hypot(2.0 * np.sin(angle / 2), ROUNDING) - ROUNDING)
        assert terms["orientation"][0] == pytest.approx(3 * expected, rel=1e-3)
    _, terms = roll_out(make_problem(HOME, FLANGE, ball(FAR_BALL)), STILL)
    assert terms["orientation"][0] == 0.0


@pytest.mark.parametrize("limit", [ARM.lower[6], ARM.upper[6]])
def test_joint_limit_term_begins_at_the_margin(roll_out, limit):
    for beyond, expected in ((-0.01, 0.0), (0.1, 3 * TERMS["joint_limit"].weight * 0.1**2)):
        q = np.append(HOME[:6], limit - np.sign(limit) * (JOINT_LIMIT_MARGIN - beyond))
        _, terms = roll_out(make_problem(q, FLANGE, ball(FAR_BALL)), STILL)
        assert terms["joint_limit"][0] == pytest.approx(expected, rel=1e-3, abs=1e-6)


@pytest.fixture(scope="module")
def cost(objective) -> CostFunction:
    """Of points (39, B) in units of the bounds."""
    bounds = np.tile([0.01] * 3 + [0.2] * 10, 3)[:, None]
    return lambda problem, points: objective.cost(problem, (points * bounds).reshape(3, 13, -1))


@pytest.fixture(scope="module")
def costs_and_slopes(cost) -> Iterator[Callable[[Problem, jax.Array], tuple[jax.Array, jax.Array]]]:
    """One program gives both for points (39, 39): compiling is what takes the time here."""

    def run(problem: Problem, points: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(functools.partial(cost, problem), (points,), (jnp.eye(39, dtype=points.dtype),))

    # XLA without its optimisations makes NaN of the derivatives in contact, as it does not with them.
    jax.config.update("jax_disable_most_optimizations", False)
    yield jax.jit(run)
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture(scope="module")
def solver_slopes(cost) -> Callable[[tuple[Problem, jax.Array], np.ndarray], jax.Array]:
    """As the solver computes them."""
    return jax.jit(Compiled(functools.partial(slopes, cost)))


@pytest.mark.parametrize("touching", [False, True])
def test_the_solvers_gradient_agrees_with_differences_of_the_solvers_cost(cost, solver_slopes, touching):
    """In single precision, to 2e-3 of the steepest slope; the program in double precision takes XLA half a minute."""
    point = np.random.default_rng(1).uniform(-0.5, 0.5, 39)
    points = np.tile(point[:, None], (1, 39)).astype(np.float32)
    obstacle = ball(beside_forearm(-0.005) if touching else FAR_BALL)
    problem = make_problem(HOME, FLANGE + np.array([0.2, 0.1, -0.1]), obstacle, orientation=0.1)
    slope = np.asarray(solver_slopes((problem, points[:, :1]), np.eye(39, dtype=np.float32)))
    costs, step = jax.jit(Compiled(cost)), np.eye(39, dtype=np.float32) / 100.0
    ahead, behind = (np.asarray(costs(problem, points + each), np.float64) for each in (step, -step))
    difference = (ahead - behind) / 0.02
    np.testing.assert_allclose(slope, difference, rtol=0, atol=2e-3 * np.abs(difference).max())


@pytest.mark.slow
@pytest.mark.parametrize("touching", [False, True])
def test_gradient_agrees_with_finite_differences(solver_slopes, costs_and_slopes, touching):
    """To 1e-6 in double precision, and to 1e-2 as the solver has it, relative to the steepest slope."""
    point = np.random.default_rng(1).uniform(-0.5, 0.5, 39)
    points = np.tile(point[:, None], (1, 39))
    obstacle = ball(beside_forearm(-0.005) if touching else FAR_BALL)
    problem = make_problem(HOME, FLANGE + np.array([0.2, 0.1, -0.1]), obstacle, orientation=0.1)
    single = solver_slopes((problem, points[:, :1].astype(np.float32)), np.eye(39, dtype=np.float32))
    assert single.dtype == np.float32
    with jax.enable_x64(True):
        double_problem = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), problem)
        _, slope = costs_and_slopes(double_problem, points)
        assert slope.dtype == np.float64
        step = 1e-5 * np.eye(39)
        ahead, _ = costs_and_slopes(double_problem, points + step)
        behind, _ = costs_and_slopes(double_problem, points - step)
    difference = (np.asarray(ahead) - np.asarray(behind)) / 2e-5
    steepest = np.abs(difference).max()
    np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-6 * steepest)
    np.testing.assert_allclose(single, difference, rtol=1e-2, atol=1e-2 * steepest)


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_joint_speeds_cost_from_half_of_their_limits_on(share):
    limits = np.array(ARM.velocity_limits)
    q = HOME[:, None, None] + share * limits[:, None, None] * np.arange(4.0)[:, None] * SMALL.knot_duration
    context = SimpleNamespace(q=jnp.asarray(q), knot_duration=SMALL.knot_duration, arm=arm_model(ARM))
    excess = max(share - 0.5, 0.0) * limits
    found = TERMS["joint_speed"].value(context)
    np.testing.assert_allclose(found, np.full((3, 1), (excess**2).sum()), rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(("joint", "speed"), [(0, 0.1), (0, 8.0), (3, 8.0)])
def test_points_faster_than_the_controllers_caps_cost(roll_out, joint, speed):
    problem = make_problem(HOME, FLANGE, ball(FAR_BALL))
    rollout, terms = roll_out(problem._replace(v=jnp.asarray(speed * np.eye(7)[:, joint : joint + 1])), STILL)
    frames = [link_frames(ARM, q[:, 0]) for q in rollout.q]
    excess = 0.0
    for capsule, masses in zip(ARM.capsules, arm_model(ARM).end_mass.T, strict=True):
        link = capsule.link - 1
        for end, mass in zip((capsule.start, capsule.end), masses, strict=True):
            path = np.array([origins[link] + rotations[link] @ end for rotations, origins in frames])
            speeds = np.linalg.norm(np.diff(path, axis=0), axis=1) / SMALL.knot_duration
            permitted = min(LimitSettings().body_speed, np.sqrt(2.0 * IMPACT_ENERGY / mass))
            excess += (np.maximum(speeds - permitted, 0.0) ** 2).sum()
    assert (excess > 1e-4) == (speed > 0.5)
    assert terms["body_speed"][0] == pytest.approx(TERMS["body_speed"].weight * excess, rel=1e-2, abs=1e-4)


def test_a_change_of_lead_costs_its_square(roll_out, objective):
    problem = make_problem(HOME, FLANGE, ball(FAR_BALL), lead_change=100.0)
    actions = np.zeros((3, 13, LANES))
    actions[:, 0, 1] = 0.01
    actions[1:, 0, 2] = 0.01
    rollout, _ = roll_out(problem, actions)
    held = jax.tree.map(lambda array: array[0, ..., :1], rollout.reference)
    terms_of = jax.jit(objective.terms)
    terms = terms_of(problem._replace(before=held), actions, rollout)
    # Nothing, one change at once, one change later.
    np.testing.assert_allclose(np.asarray(terms["lead_change"])[:3], [0.0, 0.01, 0.01], rtol=0, atol=1e-6)
    ahead = held._replace(position=FLANGE[:, None] + np.array([[0.01], [0.0], [0.0]]))
    terms = terms_of(problem._replace(before=ahead), actions, rollout)
    np.testing.assert_allclose(np.asarray(terms["lead_change"])[:2], [0.01, 0.0], rtol=0, atol=1e-6)


class TestTerms:
    def test_a_weight_without_a_term_is_refused(self):
        @dataclasses.dataclass(frozen=True)
        class Mistyped(PlanningSettings):
            heigth_weight: float = setting(1.0, "height", minimum=0.0, maximum=10.0)

        with pytest.raises(SettingsError, match="heigth_weight: expected a cost term with this weight"):
            term_weights(Mistyped())

    @pytest.mark.parametrize("value", [lambda context: context.q[:, 0], lambda context: context.q.sum()])
    def test_one_of_another_shape_is_refused(self, value, objective, monkeypatch):
        monkeypatch.setitem(TERMS, "goal", Term(value, "goal_weight"))
        problem = make_problem(HOME, FLANGE, ball(FAR_BALL))
        with pytest.raises(SettingsError, match=r"'goal' returns an array \(.*\); expected \(3, 60\), a value"):
            jax.eval_shape(lambda: objective.cost(problem, STILL))

    def test_one_more_counts_where_the_settings_have_its_weight(self, roll_out, objective, monkeypatch):
        @dataclasses.dataclass(frozen=True)
        class Raised(PlanningSettings):
            height_weight: float = setting(2.0, "height", minimum=0.0, maximum=10.0)

        rollout, _ = roll_out(make_problem(HOME, FLANGE, ball(FAR_BALL)), STILL)
        # Over lanes alone, and over knots and lanes.
        monkeypatch.setitem(TERMS, "height", Term(lambda context: -context.position[2, -1], "height_weight"))
        monkeypatch.setitem(TERMS, "heights", Term(lambda context: context.position[2, 1:], "height_weight"))
        assert not {"height", "heights"} & set(term_weights(SMALL))
        problem = make_problem(HOME, FLANGE, ball(FAR_BALL), Raised(deadline=0.0))
        monkeypatch.setattr(Objective, "roll_out", lambda *_: rollout)
        terms, cost = jax.jit(lambda: (objective.terms(problem, STILL, rollout), objective.cost(problem, STILL)))()
        heights = np.asarray(rollout.pose.position)[1:, 2]
        np.testing.assert_allclose(terms["height"], -2.0 * heights[-1], rtol=1e-6)
        np.testing.assert_allclose(terms["heights"], 2.0 * heights.sum(axis=0), rtol=1e-6)
        np.testing.assert_allclose(cost, sum(terms.values()), rtol=1e-5)


def test_a_term_needs_a_name_of_its_own():
    with pytest.raises(SettingsError, match="cost term 'joint_limit': expected a new name"):

        @term("own_weight")
        def joint_limit(context):
            return context.position[2, -1]
