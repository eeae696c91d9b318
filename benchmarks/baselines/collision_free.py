"""The baselines with a path in joint space: found once, followed by laws (1)-(3) without planning again.

The references lead along the path at the bounds γ that the method's plans have, so that neither is faster by its
bounds. Joints keep to their speed limits, which for the method is a matter of cost.
"""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.baselines.rrt_star import JointPath
from contact_reach_ros.arm import Arm, Array, link_frames_of_many
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import make_objective
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.prediction import Piece, Predictor, hold_at, pieces_between, reference_at
from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.planning.settings import POSTURE_BOUND, ROTATION_BOUND, PlanningSettings
from contact_reach_ros.resources import cache_directory
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

_SPACING = 0.002
"""Between points of a path, in joint space, rad: no point of the arm moves by more than 4 mm."""


@dataclass(frozen=True, eq=False)
class _Points:
    """Points along a path, close together.

    Attributes
    ----------
    postures
        (S, n), rad.
    positions
        (S, 3) of the tip, m.
    rotations
        (S, 3, 3) of the tip.
    """

    postures: Array
    positions: Array
    rotations: Array

    @classmethod
    def along(cls, arm: Arm, corners: Array) -> _Points:
        """Of the path through `corners` (P, n), the last one included."""
        lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(lengths)])
        count = 2 + int(arc[-1] / _SPACING)
        at = np.linspace(0.0, arc[-1], count)
        postures = np.stack([np.interp(at, arc, corner) for corner in corners.T], axis=1)
        frames, origins = link_frames_of_many(arm, postures)
        return cls(postures, origins[-1].T, frames[-1].transpose(2, 1, 0))

    def __len__(self) -> int:
        return len(self.postures)


class CollisionFreePlanner:
    """Emits references along a path that is found once, for the state and the obstacles of the first plan.

    Parameters
    ----------
    arm
        What to move.
    settings
        γ, horizon and knots are the method's; the rest is not looked at.
    gains
        Of the controller, whose motion is predicted with them.
    search
        Finds the path: from arm, posture, goal, spheres and seed.
    seed
        Of the search.
    """

    def __init__(
        self,
        arm: Arm,
        settings: PlanningSettings,
        gains: ImpedanceSettings,
        search: Callable[[Arm, Array, Target, Spheres, int], JointPath],
        seed: int,
    ) -> None:
        configure_jax(cache_directory() / "jax")
        self._arm, self._settings, self._search, self._seed = arm, settings, search, seed
        self._ramp_s = gains.reference_ramp
        self._predictor = Predictor(make_objective(arm, settings, gains).system)
        # While Kp pulls against Kd, a reference that stays this far ahead moves a joint at its speed limit.
        lead = np.array(arm.velocity_limits) * gains.task_damping / max(gains.task_stiffness, 1e-9)
        self._bounds = np.array([settings.translation_bound] * 3 + [ROTATION_BOUND] * 3)
        self._joint_bounds = np.minimum(lead, POSTURE_BOUND)
        self._plans: deque[Plan] = deque(maxlen=16)
        self._number = 0
        self._goal: Target | None = None
        self._points: _Points | None = None
        self._progress = 0
        self.path: JointPath | None = None
        """The path in use, with what its search took; None before the first plan."""

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Compile what predicts the arm."""
        begin = time.perf_counter()
        q = np.array(self._arm.home)
        timestep = self._settings.knot_duration / self._settings.substeps
        self._predictor.predict(q, np.zeros_like(q), None, [Piece(timestep, hold_at(self._arm, q))])
        progress(f"collision-free planner: ready after {time.perf_counter() - begin:.1f} s")

    def reset(self) -> None:
        """Forget path and plans."""
        self._plans.clear()
        self._number = 0
        self._goal = self._points = self.path = None
        self._progress = 0

    @property
    def memory(self) -> tuple[Any, ...]:
        """Path, progress and plans."""
        return tuple(self._plans), self._number, self._goal, self._points, self._progress, self.path

    @memory.setter
    def memory(self, memory: tuple[Any, ...]) -> None:
        self.reset()
        plans, self._number, self._goal, self._points, self._progress, self.path = memory
        self._plans.extend(plans)

    def reseed(self, seed: int) -> None:
        """Forget path and plans, and search with another seed from now on."""
        self.reset()
        self._seed = seed

    def plan(self, request: Request) -> Plan:
        """References from the path's furthest point within γ of where the arm will be, knot after knot.

        The first call, and one with another goal, searches the path, from the state as it is then; its `solve_s`
        holds the time of that.

        Raises
        ------
        PlanningError
            If there is no collision-free path.
        """
        begin = time.perf_counter()
        q, v, state_ns, effect_ns, goal, spheres, *_ = request
        if self._points is None or not goal.is_near(self._goal):
            self.path = self._search(self._arm, q, goal, spheres, self._seed)
            self._points, self._goal, self._progress = _Points.along(self._arm, self.path.postures), goal, 0
        settings = self._settings
        timestep = settings.knot_duration / settings.substeps
        hold = hold_at(self._arm, q)
        before: Any = reference_at(self._plans, effect_ns) or hold
        q, v = self._predict(q, v, pieces_between(self._plans, hold, state_ns, effect_ns, timestep))
        self._number += 1
        predicted, references = [q], []
        progress = self._progress
        for knot in range(settings.horizon):
            # A reference that moves there lags behind by half of its time.
            ahead = q + 0.5 * self._ramp_s * v
            progress = self._advance(progress, ahead)
            if knot == 0:
                self._progress = progress
            references.append(self._reference(progress, ahead))
            plan = self._plan_of(references, before, effect_ns)
            begins_ns = effect_ns + knot * plan.knot_duration_ns
            pieces = pieces_between([plan], hold, begins_ns, begins_ns + plan.knot_duration_ns, timestep)
            q, v = self._predict(q, v, pieces)
            predicted.append(q)
        _, origins = link_frames_of_many(self._arm, np.array(predicted))
        plan = dataclasses.replace(
            plan,
            predicted_q=np.array(predicted),
            predicted_positions=origins[-1].T,
            solve_s=time.perf_counter() - begin,
        )
        self._plans.append(plan)
        return plan

    def _plan_of(self, references: list[Reference], before: Reference, effect_ns: int) -> Plan:
        """A plan of these references, without the motion that follows from them."""
        nothing = np.zeros(0)
        return Plan(
            number=self._number,
            effect_ns=effect_ns,
            knot_duration_s=self._settings.knot_duration,
            positions=np.array([reference.position for reference in references]),
            rotations=np.array([reference.rotation for reference in references]),
            postures=np.array([reference.posture for reference in references]),
            predicted_q=nothing,
            predicted_positions=nothing,
            predicted_contact_forces=np.zeros((self._settings.horizon, len(self._arm.capsules))),
            cost=0.0,
            cost_terms={},
            steps=0,
            stop_reason="tracking",
            solve_s=0.0,
            before=before,
            ramp_s=self._ramp_s,
        )

    def _predict(self, q: Array, v: Array, pieces: list[Piece]) -> tuple[Array, Array]:
        q, v, _ = self._predictor.predict(q, v, None, pieces)  # type: ignore[assignment]
        return np.asarray(q, float)[:, 0], np.asarray(v, float)[:, 0]

    def _advance(self, progress: int, q: Array) -> int:
        """The furthest point from `progress` on such that all points up to it are within the bounds of posture `q`."""
        points = self._points
        assert points is not None
        here = hold_at(self._arm, q)
        # From one corner of the joint bounds to the opposite one: beyond that, they end the search anyway.
        ahead = slice(progress, progress + 2 + int(2.0 * np.linalg.norm(self._joint_bounds) / _SPACING))
        errors = np.concatenate([self._errors(ahead, here), points.postures[ahead] - q], axis=1)
        within = np.all(np.abs(errors) <= np.concatenate([self._bounds, self._joint_bounds]), axis=1)
        reachable = int(np.argmin(np.append(within, False)))
        return progress + max(reachable - 1, 0)

    def _errors(self, indices: slice, here: Reference) -> Array:
        """How far the path's points are from a pose: (N, 6), m and rad in base axes."""
        points = self._points
        assert points is not None
        turns = Rotation.from_matrix(points.rotations[indices] @ here.rotation.T).as_rotvec()
        return np.concatenate([points.positions[indices] - here.position, turns], axis=1)

    def _reference(self, progress: int, q: Array) -> Reference:
        """The point of the path, or where the arm has been pushed off the path, as much towards it as γ allows."""
        points = self._points
        assert points is not None
        here = hold_at(self._arm, q)
        error = self._errors(slice(progress, progress + 1), here)[0]
        translation = _scaled(error[:3], self._bounds[:3])
        turn = Rotation.from_rotvec(_scaled(error[3:], self._bounds[3:])).as_matrix()
        posture = q + _scaled(points.postures[progress] - q, np.full(self._arm.n, POSTURE_BOUND))
        return Reference(here.position + translation, turn @ here.rotation, posture)


def _scaled(vector: Array, bounds: Array) -> Array:
    """The vector, shortened until each component is within its bound."""
    return vector / max(1.0, float((np.abs(vector) / bounds).max()))
