"""Receding-horizon planning: a sequence of plans, each starting from what is left of the one before."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.planning.cost import Objective, Problem, Rollout, Weights
from contact_reach_ros.planning.objectives import action_bounds, actions_of, make_objective, scaled_cost
from contact_reach_ros.planning.obstacles import ObstacleReader
from contact_reach_ros.planning.patience import LEAST_SPEED, Approach
from contact_reach_ros.planning.prediction import MAX_PIECES, Held, Predictor, hold_at, pieces_between
from contact_reach_ros.planning.problem import Array, Goal, Plan, Spheres
from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.cma_es import Distribution, fresh
from contact_reach_ros.planning.solver.hybrid import CostFunction, HybridSolver, Solution
from contact_reach_ros.planning.speed_limit import steady_speed
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.warm_start import shift_distribution, shift_solution
from contact_reach_ros.resources import cache_directory
from contact_reach_ros.robot import iiwa14

_JUMP_SLACK = 0.05
"""A joint that is further from its last angle than its speed limit allows, plus this, has jumped; rad."""

_PAPER_SIGMA = 0.01
"""Of every variable, m or rad, in line 1 of Algorithm 1."""


_T = TypeVar("_T")


class Memory(NamedTuple):
    """What the next plan starts from."""

    plan: Plan
    goal: Goal
    best: np.ndarray
    """(n,) the plan as the solver has it, in units of the bounds."""
    distribution: Distribution
    """Where the solver ended."""
    approach: Approach
    """How the arm gets on."""


class History(NamedTuple):
    """All that a plan depends on besides its arguments: what a planner must know to make it again."""

    plans: tuple[Plan, ...]
    """Those that may be in force before it takes effect, in order."""
    memory: Memory
    last_state: tuple[int, Array]
    """Time in ns and joint angles (7,) in rad that the last plan was made for."""
    since_reset: int
    """Plans since the planner was reset: what selects the random numbers, together with the seed."""


class RecedingHorizonPlanner:
    """Plans references for laws (1)-(3) again and again; to be called from one thread.

    Parameters
    ----------
    settings
        The problem and its solver.
    gains
        Gains of the controller, which the transfer model runs inside.
    permitted_force
        ε of (4d), N, from the contact budget.
    capacity
        Number of obstacle spheres that the compiled program looks at; 0 compiles one without contact.
    """

    def __init__(
        self,
        settings: PlanningSettings,
        gains: ImpedanceSettings,
        permitted_force: float,
        capacity: int,
    ) -> None:
        configure_jax(cache_directory() / "jax", settings.device)
        self._settings = settings
        self._obstacles = ObstacleReader(capacity)
        self._objective = self._make_objective(gains)
        self._firm_force = settings.contact_patience_share * permitted_force
        self._least_speed = LEAST_SPEED * steady_speed(settings, gains)
        self._weights = _on_device(Weights(*(single(weight) for weight in Weights.of(settings, permitted_force))))
        self._bounds = self._make_bounds(gains)
        self._spread = _PAPER_SIGMA / self._bounds
        if settings.sampling == "bounds":
            self._spread = np.full_like(self._bounds, settings.sigma)
        self._predictor = self._make_predictor()
        self._solver = self._make_solver(scaled_cost(self._objective, self._bounds))
        self._evaluate = jax.jit(self._roll_out)
        self._plans: deque[Plan] = deque(maxlen=16)
        self._memory: Memory | None = None
        self._last_state: tuple[int, Array] | None = None
        self._number = 0
        self._since_reset = 0

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Compile every program that `plan` needs; `progress` is called with a line for the user at each stage.

        Raises
        ------
        SettingsError
            If the deadline is too short for one step of the solver on this machine.
        """
        begin = time.perf_counter()
        q, v = np.array(iiwa14.HOME_POSITION), np.zeros(iiwa14.N_JOINTS)
        goal = Goal(np.array([0.5, 0.0, 0.4]))
        obstacles, _ = self._obstacles.read(q, Spheres.none())
        pieces = pieces_between((), self._hold(q), 0, 10_000_000, self._settings.knot_duration)
        progress("planner: preparing the prediction of the arm (seconds if this machine has done it before)")
        self._predictor.predict(q, v, obstacles, pieces)
        progress("planner: preparing the evaluation of plans")
        problem = self._problem(single(q[:, None]), single(v[:, None]), obstacles, goal)
        jax.block_until_ready(self._evaluate(problem, self._points(np.zeros_like(self._bounds))))
        progress("planner: preparing the solver, the longest part (up to a minute the first time)")
        step = self._solver.warm_up(problem, self._fresh(np.zeros_like(self._bounds)))
        progress(f"planner: ready after {time.perf_counter() - begin:.1f} s, one solver step takes {1e3 * step:.1f} ms")
        if 0.0 < self._settings.deadline < step:
            raise SettingsError(
                f"planning.deadline = {self._settings.deadline:g} s: one solver step takes {step:.4f} s here; "
                "expected a deadline of several steps, 0 for none, or fewer candidates"
            )

    def reset(self) -> None:
        """Forget the plans made so far: the goal was withdrawn, or the arm moved in a way no plan asked for.

        What is planned afterwards does not depend on anything before, except for the numbers of the plans.
        """
        self._plans.clear()
        self._since_reset = 0
        self._memory = None
        self._last_state = None

    def reseed(self, seed: int) -> None:
        """Forget the plans made so far and draw other candidates from now on, as with that seed in the settings."""
        self.reset()
        self._solver.reseed(seed)

    @property
    def memory(self) -> Memory | None:
        """What the next plan starts from; None after a reset."""
        return self._memory

    @property
    def size(self) -> int:
        """Number of variables that the solver looks for."""
        return len(self._bounds)

    @property
    def since_reset(self) -> int:
        """Plans since the last reset."""
        return self._since_reset

    def history(self) -> History:
        """What the next plan depends on.

        Raises
        ------
        InputError
            If there is nothing to depend on: nothing was planned since the last reset.
        """
        if self._memory is None or self._last_state is None:
            raise InputError("no plan since the last reset: the next one starts afresh")
        return History(tuple(self._plans), self._memory, self._last_state, self._since_reset)

    def go_on_from(self, history: History) -> None:
        """Plan next as a planner with this history would."""
        self.reset()
        self._plans.extend(history.plans)
        self._memory, self._last_state = history.memory, history.last_state
        self._number, self._since_reset = history.memory.plan.number, history.since_reset

    def limit_steps(self, steps: int | None) -> None:
        """Take so many solver steps at most in a plan from now on; None for what the settings say."""
        self._solver.max_steps = self._settings.max_steps if steps is None else steps

    def plan(
        self,
        q: ArrayLike,
        v: ArrayLike,
        state_ns: int,
        effect_ns: int,
        goal: Goal,
        spheres: Spheres,
    ) -> Plan:
        """Make the plan that takes effect at `effect_ns`.

        The state is predicted from the measured one under the references in force until then: those of the plans made
        before, or a hold at the measured pose where there are none.

        Parameters
        ----------
        q, v
            (7,) measured joint angles and velocities, rad and rad/s.
        state_ns
            When they were measured, ns.
        effect_ns
            When knot 0 shall take effect, ns; not before `state_ns`.
        goal
            Where the flange shall be.
        spheres
            Obstacles at `state_ns`.

        Raises
        ------
        InputError
            If the state is not finite or of the wrong size, the times are out of order or too far apart, or no motion
            from this state has a finite cost.
        """
        begin = time.perf_counter()
        q, v = _joints("q", q), _joints("v", v)
        self._check_times(state_ns, effect_ns)
        self._reset_if_jumped(q, state_ns)
        obstacles, left_out = self._obstacles.read(q, spheres)
        timestep = self._settings.knot_duration / self._settings.substeps
        pieces = pieces_between(self._plans, self._hold(q), state_ns, effect_ns, timestep)
        problem = self._problem(*self._predictor.predict(q, v, obstacles, pieces), goal)

        distribution, start_cost = self._start(problem, goal, effect_ns)
        until = begin + self._settings.deadline if self._settings.deadline > 0.0 else math.inf
        solution = self._solver.solve(problem, distribution, start_cost, self._since_reset, until)
        if not math.isfinite(solution.cost):
            raise InputError(
                f"no motion from q = {q.tolist()}, v = {v.tolist()} has a finite cost: expected a state that the arm "
                "can be in and obstacles that do not swallow it; the plan in force runs out into a hold"
            )
        self._number += 1
        self._since_reset += 1
        rollout, terms = self._evaluate(problem, self._points(solution.best))
        plan = self._plan_of(solution, rollout, terms, effect_ns, left_out, begin)
        self._plans.append(plan)
        approach = self._approach_of(plan, goal)
        self._memory = Memory(plan, goal, solution.best, solution.distribution, approach)
        self._last_state = (state_ns, q)
        return plan

    def _approach_of(self, plan: Plan, goal: Goal) -> Approach:
        """How the arm gets on when the plan takes effect."""
        distance, memory = math.dist(plan.predicted_positions[0], goal.position), self._memory
        if memory is None or not goal.same_as(memory.goal):
            return Approach.begin(distance)
        elapsed = (plan.effect_ns - memory.plan.effect_ns) * 1e-9
        is_firm = bool((plan.predicted_contact_forces > self._firm_force).any())
        return memory.approach.go_on(distance, elapsed, self._settings.contact_patience, self._least_speed, is_firm)

    def _check_times(self, state_ns: int, effect_ns: int) -> None:
        longest_ns = round(MAX_PIECES / 4 * self._settings.knot_duration / self._settings.substeps * 1e9)
        if not 0 <= effect_ns - state_ns <= longest_ns:
            raise InputError(
                f"effect_ns - state_ns = {effect_ns - state_ns}: expected 0 to {longest_ns}; "
                "plan from a newer state, or for an earlier effect"
            )

    def _reset_if_jumped(self, q: Array, state_ns: int) -> None:
        if self._last_state is None:
            return
        last_ns, last_q = self._last_state
        elapsed = (state_ns - last_ns) * 1e-9
        reachable = np.array(iiwa14.VELOCITY_LIMITS) * elapsed + _JUMP_SLACK
        if elapsed < 0.0 or (np.abs(q - last_q) > reachable).any():
            self.reset()

    def _problem(self, q: jax.Array, v: jax.Array, obstacles: Obstacles | None, goal: Goal) -> Problem:
        rotation = np.eye(3) if goal.rotation is None else goal.rotation
        weights = self._weights
        if goal.rotation is None:
            weights = weights._replace(orientation=single(0.0))
        if self._memory is not None and goal.same_as(self._memory.goal):
            weights = weights._replace(contact=single(self._memory.approach.share * self._settings.contact_weight))
        problem = Problem(
            q=q,
            v=v,
            obstacles=obstacles,
            goal_position=single(goal.position[:, None]),
            goal_rotation=single(rotation[:, :, None]),
            weights=weights,
        )
        return _on_device(problem)

    def _start(self, problem: Problem, goal: Goal, effect_ns: int) -> tuple[Distribution, float]:
        """Where the solver starts: at the rest of the last plan, or at standing still if that costs less."""
        still = self._still(problem)
        points = self._points(still)
        carried = None
        memory = self._memory
        if memory is not None:
            elapsed = (effect_ns - memory.plan.effect_ns) / memory.plan.knot_duration_ns
            if 0.0 <= elapsed < self._settings.horizon:
                count, passed = self._vectors_per_knot * self._settings.horizon, self._vectors_per_knot * elapsed
                shifted = shift_solution(memory.best, count, passed)
                points = self._points(shifted, still)
                # A distribution that has settled on another goal would search in the wrong directions.
                if goal.same_as(memory.goal):
                    carried = shift_distribution(memory.distribution, shifted, self._spread, count, passed)
        _, terms = self._evaluate(problem, points)
        costs = np.sum([np.asarray(part) for part in terms.values()], axis=0)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        index = int(np.argmin(costs))
        best = points[:, index]
        distribution = self._fresh(best) if carried is None else carried._replace(mean=single(best))
        return distribution, float(costs[index])

    def _fresh(self, mean: np.ndarray) -> Distribution:
        return fresh(single(mean), single(self._spread))

    def _points(self, first: np.ndarray, second: np.ndarray | None = None) -> np.ndarray:
        """Two points (n, 2) for the evaluation, the first one twice if there is no second."""
        return np.stack([first, first if second is None else second], axis=1).astype(np.float32)

    # What follows depends on what is planned; another planner than one of references overrides it.

    _vectors_per_knot = 1
    """Of decision variables, one after the other in time."""

    def _make_objective(self, gains: ImpedanceSettings) -> Objective:
        return make_objective(self._settings, gains)

    def _make_bounds(self, gains: ImpedanceSettings) -> Array:
        """(n,) of the decision variables, knot after knot."""
        return action_bounds(self._settings)

    def _make_predictor(self) -> Predictor:
        return Predictor(self._objective.system)

    def _hold(self, q: Array) -> Held:
        """What is in force where no plan is, at joint angles `q` (7,)."""
        return hold_at(q)

    def _still(self, problem: Problem) -> Array:
        """The point (n,) that stands for keeping the arm still."""
        return np.zeros_like(self._bounds)

    def _make_solver(self, cost: CostFunction[Problem]) -> HybridSolver[Problem]:
        return HybridSolver(cost, len(self._bounds), self._settings)

    def _roll_out(self, problem: Problem, points: jax.Array) -> tuple[Rollout, dict[str, jax.Array]]:
        actions = actions_of(points, self._bounds, self._settings.horizon)
        rollout = self._objective.roll_out(problem, actions)
        return rollout, self._objective.terms(problem, actions, rollout)

    def _plan_of(
        self,
        solution: Solution,
        rollout: Rollout,
        terms: dict[str, jax.Array],
        effect_ns: int,
        left_out: int,
        begin: float,
    ) -> Plan:
        first = jax.tree.map(lambda array: np.asarray(array)[..., 0].astype(float), rollout)
        cost_terms = {name: float(np.asarray(values)[0]) for name, values in terms.items()}
        return Plan(
            number=self._number,
            effect_ns=effect_ns,
            knot_duration_s=self._settings.knot_duration,
            positions=first.reference.position,
            rotations=first.reference.rotation,
            postures=first.reference.posture,
            predicted_q=first.q,
            predicted_positions=first.pose.position,
            predicted_contact_forces=first.link_force,
            cost=sum(cost_terms.values()),
            cost_terms=cost_terms,
            steps=solution.steps,
            stop_reason=solution.stop_reason,
            solve_s=time.perf_counter() - begin,
            rejected=solution.rejected,
            left_out=left_out,
        )


@jax.jit
def _on_device(values: _T) -> _T:
    """What many programs will take as arguments, made JAX arrays all at once."""
    return values


def _joints(name: str, values: ArrayLike) -> Array:
    array = np.array(values, dtype=float)
    if array.shape != (iiwa14.N_JOINTS,) or not np.isfinite(array).all():
        raise InputError(f"{name} = {array.tolist()}: expected {iiwa14.N_JOINTS} finite numbers")
    return array
