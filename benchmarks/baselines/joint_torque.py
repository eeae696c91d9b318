"""The paper's comparison in Section V-B: planning joint torques instead of references of the control law.

The same cost, the same solver and the same stop rule, but the decision variables are the torques τ_t of (4c) beyond
C + g, which is known, and no law stands between plan and arm. The paper leaves open for how long a torque is held. Law
(3) changes its torque as fast as its poles, the fastest of which decays in 11 ms; a torque that stays the same for a
knot of 0.1 s would leave an undamped arm on its own for as long as the law needs to settle. So there is one torque
vector per step of the transfer model, 25 ms by default: 84 variables instead of 39. Their bounds are the largest torque
that the law can ask for at rest with actions within γ, so that both planners may accelerate the arm alike.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.law import ImpedanceLaw
from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.kernels import repulsion_torques
from contact_reach_ros.control.references import References
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, ReferenceSpace, knot_bounds, make_objective
from contact_reach_ros.planning.plan import Held, Plan, ReferenceTrajectory
from contact_reach_ros.planning.prediction import reference_at
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.solver import Solution
from contact_reach_ros.planning.terms import Problem, Rollout
from contact_reach_ros.planning.transfer.contact import contact_step
from contact_reach_ros.planning.transfer.dynamics import Dynamics, arm_dynamics, link_frames
from contact_reach_ros.planning.transfer.pipeline import Reference, State, System, capped, factorise_mass
from contact_reach_ros.timing import PERIOD

SIGMA = 0.05
"""Initial standard deviation of the candidates as a share of the bounds.

The planner's own default, 0.3, suits references, which the law follows smoothly. Torques drawn that widely throw the
arm about: none of them is better than standing still, and the arm stays in front of a ball.
"""

_DAMPING = 20.0
"""Of the strongest joint, N m s/rad."""


class HeldTorque(NamedTuple):
    """A command τ − D q̇ beyond C + g that does not change with time."""

    torque: Array
    """(n,) τ, N m."""
    damping: Array | None
    """(n,) diagonal of D, N m s/rad, or None for no damping."""


def torque_bounds(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings, q: Array) -> Array:
    """Largest torque (7,) beyond C + g that law (3) can ask for at rest at `q` (7,) with actions within γ, N m."""
    model = RobotModel(arm)
    rest = np.zeros(arm.n)
    model.update(q, rest)
    law = ImpedanceLaw(arm, gains)
    total = np.zeros(arm.n)
    bounds = knot_bounds(arm, settings)
    for variable, bound in enumerate(bounds):
        action = np.zeros_like(bounds)
        action[variable] = bound
        total += np.abs(law.torque(model, rest, -action[6:], -action[:6]))
    return np.minimum(total, arm.torque_limits)


def torque_step(system: System, state: State, act: HeldTorque) -> State:
    """As `pipeline.step`, under a command (7, B) instead of law (3); `damping` may be None where there is none."""
    timestep = system.timestep
    q = state.q + (0.5 * timestep) * state.qd
    frames = link_frames(system.arm, q)
    torque: Any = act.torque
    obstacles, link_force = state.obstacles, state.link_force
    if obstacles is not None:
        contact = contact_step(system.arm, frames, obstacles, timestep)
        obstacles, link_force = obstacles._replace(center=contact.center), contact.link_force
        torque = torque + contact.joint_torque
    dynamics = arm_dynamics(system.arm, frames)
    if act.damping is not None:
        # Implicit: the wrist's inertia is too small for its damping at such steps.
        torque = torque - act.damping * state.qd
        added = timestep * act.damping[:, None] * np.eye(state.q.shape[0])[:, :, None]
        dynamics = dynamics._replace(mass_matrix=dynamics.mass_matrix + added)
    acceleration = _driven_acceleration(dynamics, torque)
    qd = capped(system.arm, state.qd + timestep * acceleration)
    return State(q + (0.5 * timestep) * qd, qd, obstacles, link_force)


def _driven_acceleration(dynamics: Dynamics, torque: jax.Array) -> jax.Array:
    """Joint acceleration M⁻¹ τ (n, B) under joint torques beyond C + g (n, B), without any control law."""
    factor, solved, pivots = factorise_mass(dynamics.mass_matrix, torque[None])
    n = len(torque)
    acceleration: list[jax.Array] = [torque[0]] * n
    for joint in reversed(range(n)):
        total = solved[joint][0]
        for later in range(joint + 1, n):
            total = total - factor[joint][later - joint] * acceleration[later]
        acceleration[joint] = total / pivots[joint]
    return jnp.stack(acceleration)


@dataclass(frozen=True, eq=False)
class TorqueObjective(Objective):
    """Cost (5) of joint torques: actions are (H, 7 * substeps, B), N m, step after step."""

    def roll_out(self, problem: Problem, actions: jax.Array) -> Rollout:
        """Run the transfer model without the laws under the actions, knot by knot."""
        start, _ = self.transfer(problem, actions.shape[-1])
        first = self.end_of_knot(start.q)

        def knot(state: State, action: jax.Array) -> tuple[State, tuple]:
            state, link_force = self.advance(state, action)
            contact = link_force.max(axis=1)
            return state, (state.q, self.end_of_knot(state.q), link_force.max(axis=0), contact.max(axis=0))

        _, (q, ends, link_force, contact) = jax.lax.scan(knot, start, actions)
        poses, capsules = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), first, ends)
        # There are no references; the cost does not look at them.
        reference = Reference(poses.position[1:], poses.rotation[1:], q)
        return Rollout(jnp.concatenate([start.q[None], q]), poses, reference, link_force, contact, capsules)

    def terms(self, problem: Problem, actions: jax.Array, rollout: Rollout) -> dict[str, jax.Array]:
        """As for references, less what Δx and Δq cost, which do not exist."""
        weights = {**problem.weights, "null_motion": 0.0, "lead_change": 0.0}
        return super().terms(problem._replace(weights=weights), actions, rollout)

    def advance(self, state: State, action: jax.Array) -> tuple[State, jax.Array]:
        """State after one knot under an action (7 * substeps, B), and the forces (substeps, 6, B) on the links."""

        def step(state: State, torque: Any) -> tuple[State, jax.Array]:
            state = torque_step(self.system, state, HeldTorque(torque, None))
            return state, state.link_force

        return jax.lax.scan(step, state, action.reshape(self.substeps, state.q.shape[0], -1))


def make_torque_objective(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> TorqueObjective:
    """The cost over the transfer model without the laws."""
    closed = make_objective(arm, dataclasses.replace(settings, pipeline="closed_loop"), gains)
    return TorqueObjective(closed.system, closed.horizon, closed.substeps)


@dataclass(frozen=True, eq=False, kw_only=True)
class TorquePlan(Plan):
    """A plan of torques; `positions`, `rotations` and `postures` are what it expects at the ends of its knots."""

    torques: Array
    """(S, 7) beyond C + g, N m, each in force for an equal part of the plan's time."""

    def references(self) -> TorqueReferences:
        """The plan itself, for a `TorqueController`."""
        return TorqueReferences(self.effect_ns, (), self.positions, self.rotations, self.postures, plan=self)

    @property
    def changes_ns(self) -> list[int]:
        """When the torque changes, ns, from the effect to the expiry."""
        duration_ns = self.knot_duration_ns * len(self.positions)
        count = len(self.torques)
        return [self.effect_ns + round(index * duration_ns / count) for index in range(count + 1)]

    def in_force(self, time_ns: int) -> HeldTorque | None:
        """The torque at a time after the effect, ns; None once the plan has run out."""
        index = int(np.searchsorted(self.changes_ns, time_ns, side="left")) - 1
        if index >= len(self.torques):
            return None
        return HeldTorque(self.torques[index], np.zeros_like(self.torques[index]))


class TorqueSpace(ReferenceSpace):
    """Decision variables: joint torques, one vector for each step of the transfer model."""

    def __init__(self, arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> None:
        self.objective = make_torque_objective(arm, settings, gains)
        bounds = torque_bounds(arm, settings, gains, np.array(arm.home))
        self.vectors = settings.horizon * settings.substeps
        self.bounds = np.tile(bounds, self.vectors)
        self.spread = np.full_like(self.bounds, SIGMA)

    def actions(self, points: jax.Array, problem: Problem) -> jax.Array:
        """Torques (H, n * substeps, B), N m, of points (N, B)."""
        return (points * self.bounds[:, None]).reshape(self.objective.horizon, -1, points.shape[1])


class TorquePlanner(RecedingHorizonPlanner):
    """Plans joint torques.

    Parameters
    ----------
    damping
        (n,) of the joints where no plan is in force, N m s/rad.
    """

    _make_space = TorqueSpace
    _advance = staticmethod(torque_step)

    def __init__(
        self,
        arm: Arm,
        settings: PlanningSettings,
        controller: ControllerSettings,
        permitted_force: float,
        capacity: int,
        damping: Array,
    ) -> None:
        # Detours are led by references.
        settings = dataclasses.replace(settings, detour_patience=0.0)
        super().__init__(arm, settings, controller, permitted_force, capacity)
        self._damping = damping
        self._ramp_s = 0.0
        self._model = RobotModel(arm)

    def _hold(self, q: Array) -> Held:
        """Damped joints."""
        return HeldTorque(np.zeros(self._arm.n), self._damping)

    def _still(self, problem: Problem) -> Array:
        """Torques that would stop the arm within the first knot; none at all would let it coast on."""
        q, v = (np.asarray(values, float)[:, 0] for values in (problem.q, problem.v))
        self._model.update(q, v)
        point = np.zeros((self._settings.horizon, self._settings.substeps, self._arm.n))
        point[0] = -self._model.mass_matrix @ v / self._settings.knot_duration
        return np.clip(point.ravel() / self._space.bounds, -1.0, 1.0)

    def _followed(self, q: Array, state_ns: int) -> Sequence[ReferenceTrajectory]:
        """All plans: the controller drops none of torques."""
        return () if self.memory is None else self.memory.trajectories

    def _plan_of(self, solution: Solution, *others: Any) -> TorquePlan:
        """The plan with its torques."""
        plan = super()._plan_of(solution, *others)
        torques = (solution.best * self._space.bounds).reshape(-1, self._arm.n)
        values = {field.name: getattr(plan, field.name) for field in dataclasses.fields(plan)}
        return TorquePlan(**values, torques=torques)


@dataclass(frozen=True, eq=False)
class TorqueReferences(References):
    """Passes a plan of torques to the controller."""

    plan: TorquePlan = field(kw_only=True)


def joint_damping(arm: Arm) -> Array:
    """Damping (n,) of joints for which no torques are planned, N m s/rad, in proportion to their torque limits."""
    return _DAMPING * arm.torque_limits / arm.torque_limits.max()


class TorqueController(Controller):
    """Applies planned torques plus C + g as they are, without feedback other than planning again.

    Until the first plan takes effect, the controller holds the arm; when a plan has run out, joints are damped. Torques
    are capped at the data sheet's limits, and joints near their limits are pushed back, as with the other methods.
    """

    def __init__(self, arm: Arm, settings: ControllerSettings, period: float = PERIOD) -> None:
        super().__init__(arm, settings, period)
        self._limits_only = make_constants(arm, limits=settings.limits, period=period)
        self._damping = joint_damping(arm)
        self._plans: list[Plan] = []

    def follow(self, references: References) -> None:
        """Take the torques of a plan; they are in force from its effect on."""
        if not isinstance(references, TorqueReferences):
            super().follow(references)
            return
        # The newest plan that is in force, and those that are not yet.
        now_ns = self.stamp_ns
        newest = max((other.effect_ns for other in self._plans if other.effect_ns <= now_ns), default=now_ns)
        self._plans = [other for other in self._plans if other.effect_ns >= newest] + [references.plan]

    def _tick(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> Array | None:
        """The torque of the plan in force, or what holds or stops the arm."""
        if self.stop_reason or not any(plan.effect_ns <= now_ns for plan in self._plans):
            return super()._tick(q, v, now_ns, clock_ns)
        self.model.update(q, v)
        held = reference_at(self._plans, now_ns + 1)
        torque = self.model.bias.copy()
        torque += held.torque if isinstance(held, HeldTorque) else -self._damping * v
        torque += sum(repulsion_torques(self._limits_only, self.model.mass_matrix, q, v))
        limits = self.arm.torque_limits
        return np.clip(torque, -limits, limits)
