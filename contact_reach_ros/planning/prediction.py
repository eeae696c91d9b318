"""Prediction of the state in which a plan takes effect: the transfer model under the references in force until then."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.control.references import Reference
from contact_reach_ros.planning.plan import Held, ReferenceTrajectory
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.pipeline import State, System

MAX_PIECES = 128
"""Steps that one prediction may take."""


def hold_at(arm: Arm, q: Array) -> Reference:
    """The reference that holds the arm at joint angles `q` (n,)."""
    rotations, origins = link_frames(arm, q)
    return Reference(origins[-1], rotations[-1], q)


class Piece(NamedTuple):
    """A short stretch of time, with the mean of what is in force."""

    duration: float
    """s."""
    held: Held


def reference_at(plans: Sequence[ReferenceTrajectory], time_ns: int) -> Held | None:
    """What is in force at a time: the latest plan that has taken effect, or None if it has run out."""
    for plan in reversed(plans):
        if plan.effect_ns < time_ns:
            return plan.in_force(time_ns)
    return None


def followed(
    plans: Sequence[ReferenceTrajectory], tip: Array, time_ns: int, speed: float, max_position_error: float
) -> list[ReferenceTrajectory]:
    """The plans as the controller follows them: those whose x_d is too far from the tip have no knots.

    It drops such a plan and holds the arm.

    Parameters
    ----------
    tip
        (3,) position of the flange, m.
    time_ns
        Time of that, ns.
    speed
        At which the tip may still come nearer to x_d until a plan takes effect, m/s.
    max_position_error
        Distance of x_d from the tip above which the controller drops a plan, m.
    """

    def is_dropped(plan: ReferenceTrajectory) -> bool:
        elapsed_ns = time_ns - plan.effect_ns
        nearer = -1e-9 * elapsed_ns * speed if elapsed_ns < 0 else 0.0
        knot = max(0, elapsed_ns - 1) // plan.knot_duration_ns
        return any(math.dist(x_d, tip) > max_position_error + nearer for x_d in plan.positions[knot : knot + 1])

    return [plan.without_knots() if is_dropped(plan) else plan for plan in plans]


def pieces_between(
    plans: Sequence[ReferenceTrajectory], hold: Held, start_ns: int, end_ns: int, longest: float
) -> list[Piece]:
    """Cut (start, end] where what is in force begins to change, and into pieces of at most `longest` seconds.

    `hold` is in force without a plan.
    """
    # A plan is in force until the next one takes effect.
    lasts = [*(plan.effect_ns for plan in plans), end_ns][1:]
    changes: set[int] = set()
    for plan, last in zip(plans, lasts, strict=False):
        changes.update(instant for instant in plan.changes_ns if instant <= last)
    instants = [start_ns, *sorted(instant for instant in changes if start_ns < instant < end_ns), end_ns]
    pieces = []
    for begin, end in itertools.pairwise(instants):
        duration = (end - begin) * 1e-9
        count = max(1, int(np.ceil(duration / longest - 1e-9)))
        for index in range(count):
            # Its mean, as it changes linearly.
            middle = begin + round((index + 0.5) * (end - begin) / count)
            pieces.append(Piece(duration / count, reference_at(plans, middle) or hold))
    return pieces


class Predictor:
    """Runs the transfer model, one lane wide, over pieces of time.

    Parameters
    ----------
    system
        The closed loop; no piece may be longer than its time step.
    step
        Advances the system by one time step under what a piece holds.
    """

    def __init__(self, system: System, step: Callable[[System, State, Any], State] = pipeline.step) -> None:
        self._system = system
        self._step = step
        self._run = jax.jit(self._advance)

    def predict(
        self, q: Array, v: Array, obstacles: Obstacles | None, pieces: Sequence[Piece]
    ) -> tuple[jax.Array, jax.Array, Obstacles | None]:
        """Joint angles (n, 1), speeds (n, 1) and obstacles after the pieces, at most `MAX_PIECES` of them."""
        count = len(pieces)
        durations = np.zeros(MAX_PIECES, np.float32)
        durations[:count] = [piece.duration for piece in pieces]

        def rows(*values: Array) -> jax.Array:
            padded = np.zeros((MAX_PIECES, *values[0].shape, 1), np.float32)
            padded[:count, ..., 0] = values
            return single(padded)

        held = jax.tree.map(rows, *(piece.held for piece in pieces))
        state = self._run(single(q[:, None]), single(v[:, None]), obstacles, held, durations, count)
        return state.q, state.qd, state.obstacles

    def _advance(
        self,
        q: jax.Array,
        v: jax.Array,
        obstacles: Obstacles | None,
        held: Any,
        durations: jax.Array,
        count: jax.Array,
    ) -> State:
        def piece(index: jax.Array, state: State) -> State:
            system = dataclasses.replace(self._system, timestep=durations[index])
            return self._step(system, state, jax.tree.map(lambda rows: rows[index], held))

        return jax.lax.fori_loop(0, count, piece, pipeline.init(self._system, q, v, obstacles))
