"""Receding-horizon planning: a sequence of plans, each of which starts from the rest of the previous one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.agreement import plan_basis
from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.control.references import MAX_PLAN_DURATION, Reference
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.errors import InputError, PlanningError, SettingsError
from contact_reach_ros.planning.cost import ReferenceSpace
from contact_reach_ros.planning.detour import Detours
from contact_reach_ros.planning.lanes.compiled import Compiled
from contact_reach_ros.planning.obstacles import ObstacleReader, check_motion, nearest_bodies
from contact_reach_ros.planning.plan import Held, Plan, ReferenceTrajectory, Request
from contact_reach_ros.planning.prediction import MAX_PIECES, Predictor, followed, hold_at, pieces_between, reference_at
from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.planning.settings import PlanningSettings, steady_speed
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.solver.solver import CostFunction, FloatArray, Solution, Solver, shift_solution
from contact_reach_ros.planning.terms import LEAST_SPEED, Approach, Problem, Rollout, term_weights
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.planning.transfer.clearance import Bodies
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.resources import cache_directory
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres


class Memory(NamedTuple):
    """Everything that the next plan depends on besides its request and the seed."""

    trajectories: tuple[ReferenceTrajectory, ...]
    """The last plans, in order; one of them is in force when the next plan is made."""
    request: Request
    """What the last plan was made for, or one after it that would have brought the arm into a collision."""
    best: np.ndarray
    """(N,) the last plan as a point of the solver's box."""
    approach: Approach
    """Progress towards the goal."""
    plans: int
    """Number of plans since the planner was reset, which selects the random numbers together with the seed."""


FORCE_SHARE = 0.95
"""Share of ε up to which plans press: friction and damping of contacts, which the model leaves out, add to it."""

_JUMP_SLACK = 0.05
"""Slack in the detection of jumps, rad: a joint farther from its last angle than its speed limit allows has jumped."""

_WORTH = 1e-3
"""What a motion has to gain over standing still, m of the way: at its goal an arm would go on moving its elbow."""

_WARM_UP_PLANS = 5
"""Two that compile, and three of which the quickest tells how long a step takes."""

_PLANS_KEPT = 16
"""How many of its last plans a planner keeps: one of them is in force when the next is made."""


class RecedingHorizonPlanner:
    """Plans references for laws (1)-(3) continuously, from one thread.

    Parameters
    ----------
    arm
        Arm to plan for.
    settings
        The problem and its solver.
    controller
        Settings of the controller that follows the plans: the transfer model contains its gains, and the cost its caps.
    permitted_force
        ε of (4d), N, from the contact budget.
    capacity
        Number of obstacle spheres that the compiled program takes; 0 compiles one without contact.
    solver
        Makes the solver from a cost, the spread of its variables and the settings.

    Attributes
    ----------
    basis
        What the plans are made for, see `agreement`.
    memory
        What the next plan starts from; None after a reset. It may be set to an earlier value.
    """

    _make_space = ReferenceSpace
    _advance: Callable[[pipeline.System, pipeline.State, Any], pipeline.State] = staticmethod(pipeline.step)
    """A step of what the start of a plan is predicted with."""

    def __init__(
        self,
        arm: Arm,
        settings: PlanningSettings,
        controller: ControllerSettings,
        permitted_force: float,
        capacity: int,
        solver: Callable[[CostFunction, FloatArray, PlanningSettings], Solver] = HybridSolver,
    ) -> None:
        configure_jax(cache_directory() / "jax")
        controller = controller.resolve(arm)
        gains = controller.impedance
        self.basis = plan_basis(arm, controller)
        self._arm = arm
        self._settings = settings
        self._obstacles = ObstacleReader(arm, capacity)
        self._permitted_force = FORCE_SHARE * permitted_force
        self._detours = Detours(arm, settings, permitted_force)
        self._speed = steady_speed(settings, gains)
        self._max_position_error = controller.supervision.max_position_error
        self._body_speed = controller.limits.body_speed
        self._ramp_s = gains.reference_ramp
        self._space = self._make_space(arm, settings, gains)
        self._predictor = Predictor(self._space.objective.system, self._advance)
        self._solver = solver(self._space.cost, self._space.spread, settings)
        self._evaluate = jax.jit(Compiled(self._roll_out))
        self.memory: Memory | None = None
        self._number = 0
        self._last_check_s = 0.0

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Compile every program that `plan` needs; `progress` is called with a line for the user at each stage.

        Raises
        ------
        SettingsError
            If the deadline is too short for one step of the solver on this machine.
        """
        progress("planner: preparing the programs (seconds if this machine has done it before, else up to a minute)")
        begin = time.perf_counter()
        q = np.array(self._arm.home)
        request = Request(q, np.zeros(self._arm.n), 0, 0, Target(hold_at(self._arm, q).position), Spheres.none())
        spent = []
        for _ in range(_WARM_UP_PLANS):
            # CPU time: another program that is busy meanwhile does not count.
            began = time.process_time()
            plan = self.plan(request)
            spent.append((time.process_time() - began) / plan.steps)
        self.reset()
        self._number = 0
        # The first plan compiles what it needs, the second what it needs to continue the one before.
        step = min(spent[2:])
        progress(f"planner: ready after {time.perf_counter() - begin:.1f} s, one solver step takes {1e3 * step:.1f} ms")
        if 0.0 < self._settings.deadline < step:
            raise SettingsError(
                f"planning.deadline = {self._settings.deadline:g} s: one solver step takes {step:.4f} s here; "
                "expected a deadline of several steps, 0 for none, or fewer candidates"
            )

    def reset(self) -> None:
        """Forget the plans made so far: the goal was withdrawn, or the arm moved in a way that no plan asked for.

        Later plans do not depend on anything before, except for their numbers.
        """
        self.memory = None

    def reseed(self, seed: int) -> None:
        """Forget the plans made so far and draw other candidates from now on."""
        self.reset()
        self._solver.reseed(seed)

    def plan(self, request: Request) -> Plan:
        """Make a plan.

        The start is predicted from the measured state under the references in force until the plan takes effect: those
        of the previous plans, or a hold at the measured pose without any, and where x_d is so far from the tip that the
        controller drops the plan.

        Raises
        ------
        InputError
            If the state is not finite or of the wrong size, the times are out of order or too far apart, or no motion
            from this state has a finite cost.
        PlanningError
            If even the best motion would bring the arm into a rigid body or into itself.
        UnreachableError
            If every posture at a new goal presses too hard, or no detour is left, see `Detours.target`.
        """
        begin = time.perf_counter()
        q, v = self._joints("q", request.q), self._joints("v", request.v)
        state_ns, effect_ns, spheres = request.state_ns, request.effect_ns, request.spheres
        self._check_times(state_ns, effect_ns)
        self._reset_if_jumped(q, state_ns)
        last = None if self.memory is None else self.memory.request
        request = self._detours.target(request._replace(q=q, v=v), last)
        # The search of a posture takes longer than a plan. What comes after the solver counts as it took last time.
        deadline = self._settings.deadline
        until = time.perf_counter() + deadline - self._last_check_s if deadline > 0.0 else math.inf
        obstacles = self._obstacles.read(q, spheres)
        timestep = self._settings.knot_duration / self._settings.substeps
        hold = self._hold(q)
        plans = self._followed(q, state_ns)
        pieces = pieces_between(plans, hold, state_ns, effect_ns, timestep)
        bodies = nearest_bodies(self._arm, q, spheres.environment)
        # From which the reference moves, unless it steps.
        in_force = reference_at(plans, effect_ns)
        before = Reference(*(in_force or hold)) if self._ramp_s else None
        problem = self._problem(*self._predictor.predict(q, v, obstacles, pieces), request, bodies, before)

        start, start_cost = self._start(problem, request)
        memory = self.memory
        since_reset = 0 if memory is None else memory.plans
        held = in_force if isinstance(in_force, Reference) and request.holds and not request.on_detour else None
        if held is not None and self._permits(problem, start):
            solution = Solution(start, start_cost, 0, "held", (start_cost,))
        else:
            held = None
            solution = self._solver.solve(problem, start, start_cost, since_reset, until)
        if not math.isfinite(solution.cost):
            raise InputError(
                f"no motion from q = {q.tolist()}, v = {v.tolist()} has a finite cost: expected a state that the arm "
                "can be in and obstacles that do not swallow it; the plan in force runs out into a hold"
            )
        solved = time.perf_counter()
        rollout, terms = self._evaluate(problem, _pair(solution.best))
        predicted_q = np.asarray(rollout.q)[..., 0].astype(float)
        try:
            check_motion(self._arm, predicted_q, spheres.environment)
        except PlanningError:
            # Where every plan ends like this the arm makes no progress, and a detour is due.
            self.memory = None if memory is None else memory._replace(request=request)
            raise
        finally:
            self._last_check_s = time.perf_counter() - solved
        self._number += 1
        plan = self._plan_of(solution, rollout, terms, request, begin, before, held)
        earlier = () if memory is None else memory.trajectories[1 - _PLANS_KEPT :]
        approach, trajectories = self._approach_of(plan, request), (*earlier, plan)
        self.memory = Memory(trajectories, request, solution.best, approach, since_reset + 1)
        return plan

    def _permits(self, problem: Problem, point: Array) -> bool:
        """Whether the motion of a point (N,) presses no harder than is permitted: from where it begins, as now."""
        rollout, _ = self._evaluate(problem, _pair(point))
        return not bool((np.asarray(rollout.link_force) > self._permitted_force).any())

    def _hold(self, q: Array) -> Held:
        """What is in force without a plan, at joint angles `q` (n,), rad."""
        return hold_at(self._arm, q)

    def _still(self, problem: Problem) -> Array:
        """The point (N,) that keeps the arm still."""
        return np.zeros_like(self._space.bounds)

    def _followed(self, q: Array, state_ns: int) -> Sequence[ReferenceTrajectory]:
        """The last plans, as far as the controller follows them from joint angles `q` (n,), rad."""
        if self.memory is None:
            return ()
        tip = hold_at(self._arm, q).position
        return followed(self.memory.trajectories, tip, state_ns, self._speed, self._max_position_error)

    def _approach_of(self, plan: Plan, request: Request) -> Approach:
        """Progress towards the goal when the plan takes effect."""
        position, memory, settings = plan.predicted_positions[0], self.memory, self._settings
        rotation = link_frames(self._arm, plan.predicted_q[0])[0][-1] if settings.orientation_weight else None
        if memory is None or not request.goal.is_near(memory.request.goal) or request.on_detour:
            return Approach(position, rotation=rotation)
        elapsed = (plan.effect_ns - memory.trajectories[-1].effect_ns) * 1e-9
        is_firm = bool((plan.predicted_contact_forces > self._permitted_force).any())
        least_speed, patience = plan.speed_scale * LEAST_SPEED * self._speed, settings.contact_patience
        return memory.approach.updated(position, request.goal, elapsed, patience, least_speed, is_firm, rotation)

    def _joints(self, name: str, values: ArrayLike) -> Array:
        array = np.array(values, dtype=float)
        if array.shape != (self._arm.n,) or not np.isfinite(array).all():
            raise InputError(f"{name} = {array.tolist()}: expected {self._arm.n} finite numbers")
        return array

    def _check_times(self, state_ns: int, effect_ns: int) -> None:
        longest_ns = round(MAX_PIECES / 4 * self._settings.knot_duration / self._settings.substeps * 1e9)
        if not 0 <= effect_ns - state_ns <= longest_ns:
            raise InputError(
                f"effect_ns - state_ns = {effect_ns - state_ns}: expected 0 to {longest_ns}; "
                "plan from a newer state, or for an earlier effect"
            )

    def _reset_if_jumped(self, q: Array, state_ns: int) -> None:
        if self.memory is None:
            return
        last = self.memory.request
        elapsed = (state_ns - last.state_ns) * 1e-9
        reachable = self._arm.velocity_limits * elapsed + _JUMP_SLACK
        if elapsed < 0.0 or (np.abs(q - last.q) > reachable).any():
            self.reset()

    def _problem(
        self,
        q: jax.Array,
        v: jax.Array,
        obstacles: Obstacles | None,
        request: Request,
        bodies: Bodies,
        before: Reference | None,
    ) -> Problem:
        goal, detour, memory, weights = request.goal, request.detour, self.memory, term_weights(self._settings)
        rotation = np.eye(3) if request.rotation is None else request.rotation
        if request.rotation is None:
            weights["orientation"] = 0.0
        if memory is not None and goal.is_near(memory.request.goal):
            weights |= memory.approach.weights(self._settings)
        if detour is not None:
            weights |= detour.weights(self._settings)
        problem = Problem(
            q=q,
            v=v,
            obstacles=obstacles,
            goal_position=single(goal.position[:, None]),
            goal_rotation=single(rotation[:, :, None]),
            goal_velocity=single(goal.velocity[:, None]),
            weights={name: single(weight) for name, weight in weights.items()},
            permitted_force=single(self._permitted_force),
            body_speed=single(self._body_speed),
            bodies=bodies,
            speed_scale=single(request.speed_scale),
            before=None if before is None else pipeline.Reference(*(single(part[..., None]) for part in before)),
            detour=None if detour is None else single(detour.posture[:, None]),
        )
        return jax.device_put(problem)

    def _start(self, problem: Problem, request: Request) -> tuple[Array, float]:
        """A point (N,) to start from, and its cost.

        It is the rest of the last plan, or standing still unless that costs `_WORTH` more.
        """
        # The second one is standing still.
        points = _pair(self._still(problem))
        memory = self.memory
        if memory is not None:
            elapsed = (request.effect_ns - memory.trajectories[-1].effect_ns) / memory.trajectories[-1].knot_duration_ns
            if 0.0 <= elapsed < self._settings.horizon:
                count = self._space.vectors
                passed = elapsed * count / self._settings.horizon
                points = _pair(shift_solution(memory.best, count, passed), points[:, 0])
        costs = self._costs(problem, points)
        if request.on_detour and request.detour is not None:
            ahead = _pair(self._space.towards(request.q, request.detour.posture))
            points, costs = np.hstack([points, ahead]), np.append(costs, self._costs(problem, ahead))
        index = int(np.argmin(costs - _WORTH * (np.arange(len(costs)) == 1)))
        return points[:, index], float(costs[index])

    def _costs(self, problem: Problem, points: np.ndarray) -> np.ndarray:
        """Costs (2,) of two points (N, 2)."""
        _, terms = self._evaluate(problem, points)
        costs = np.sum([np.asarray(part) for part in terms.values()], axis=0)
        return np.where(np.isfinite(costs), costs, np.inf)

    def _plan_of(
        self,
        solution: Solution,
        rollout: Rollout,
        terms: dict[str, jax.Array],
        request: Request,
        begin: float,
        before: Reference | None,
        held: Reference | None,
    ) -> Plan:
        first = jax.tree.map(lambda array: np.asarray(array)[..., 0].astype(float), rollout)
        knots = first.reference
        if held is not None:
            knots = Reference(*(np.repeat(part[None], len(knots.position), axis=0) for part in held))
        if self._detours.may_search(request):
            # Without a plan the controller gives way to contact, and stops where that does not end it.
            count = int(MAX_PLAN_DURATION / self._settings.knot_duration)
            knots = Reference(*(part[np.minimum(np.arange(max(count, len(part))), len(part) - 1)] for part in knots))
        cost_terms = {name: float(np.asarray(values)[0]) for name, values in terms.items()}
        return Plan(
            number=self._number,
            effect_ns=request.effect_ns,
            knot_duration_s=self._settings.knot_duration,
            positions=knots.position,
            rotations=knots.rotation,
            postures=knots.posture,
            predicted_q=first.q,
            predicted_positions=first.pose.position,
            predicted_contact_forces=first.link_force,
            cost=sum(cost_terms.values()),
            cost_terms=cost_terms,
            steps=solution.steps,
            stop_reason=solution.stop_reason,
            solve_s=time.perf_counter() - begin,
            before=before,
            speed_scale=request.speed_scale,
            ramp_s=self._ramp_s,
        )

    def _roll_out(self, problem: Problem, points: jax.Array) -> tuple[Rollout, dict[str, jax.Array]]:
        """The motion and the terms of the cost for points (N, B)."""
        actions = self._space.actions(points, problem)
        rollout = self._space.objective.roll_out(problem, actions)
        return rollout, self._space.objective.terms(problem, actions, rollout)


def _pair(first: np.ndarray, second: np.ndarray | None = None) -> np.ndarray:
    """Two points (N, 2) for the evaluation, the first one twice if there is no second."""
    return np.stack([first, first if second is None else second], axis=1).astype(np.float32)
