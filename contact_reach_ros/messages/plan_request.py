"""The message plan/request: what a plan was made for and started from, so that it can be solved again.

It is a std_msgs/Float32MultiArray whose dimensions name the parts one after the other. Single precision is enough: a
plan that is solved again is the same within tolerances. The times of state and effect, the number of solver steps and
the obstacles that the planner knew are in plan/statistics.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.planning.detour import Detour
from contact_reach_ros.planning.memory import Memory
from contact_reach_ros.planning.patience import Approach
from contact_reach_ros.planning.plan import HeldReference, ReferenceTrajectory
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.solver.solver import State
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

Parts = dict[str, NDArray[np.float32]]

_POSE = 12
"""Numbers of a position and a rotation."""

_SOLVER = "solver "
"""Prefix of the fields of the solver's state."""
_TRAJECTORY = "trajectory "
"""Prefix of the trajectories that may be in force until the plan takes effect."""


def request_parts(number: int, request: Request, memory: Memory | None) -> Parts:
    """The parts of the message of plan `number`, which started from `memory`; None after a reset."""
    parts = {
        "plan": np.array([number]),
        "q": request.q,
        "v": request.v,
        "goal": _goal_numbers(request.goal),
        "speed scale": np.array([request.speed_scale]),
        "detours": np.array([request.detours]),
    }
    if memory is not None:
        parts["plans since reset"] = np.array([memory.plans])
        parts["last goal"] = _goal_numbers(memory.request.goal)
        parts["best"] = memory.best
        parts["approach"] = np.array(memory.approach)
        if memory.detour is not None:
            parts["detour"] = np.array([*memory.detour[:-1], *memory.detour.posture])
        for index, trajectory in enumerate(_in_force(memory.trajectories, request.state_ns)):
            parts[f"{_TRAJECTORY}{index}"] = _trajectory_numbers(trajectory, request.state_ns)
        for name, values in memory.state._asdict().items():
            parts[f"{_SOLVER}{name}"] = _packed(np.asarray(values))
    return {name: np.ravel(values).astype(np.float32) for name, values in parts.items()}


def read_request(parts: Mapping[str, NDArray[np.float32]], times: tuple[int, int]) -> Request:
    """The request, without obstacles; `times` are those of state and effect, ns.

    Raises
    ------
    KeyError
        If a part is missing.
    """
    values = _doubles(parts)
    goal, scale, detours = _goal(values["goal"]), float(values["speed scale"][0]), bool(values["detours"][0])
    return Request(values["q"], values["v"], *times, goal, Spheres.none(), scale, detours)


def read_memory(
    parts: Mapping[str, NDArray[np.float32]], request: Request, like: State, knot_duration_s: float, ramp_s: float
) -> Memory | None:
    """What the plan started from; None after a reset.

    Parameters
    ----------
    parts
        Of the message.
    request
        The request in it.
    like
        A state of the solver, with the fields, shapes and types of the recorded one.
    knot_duration_s, ramp_s
        Of the trajectories, s.

    Raises
    ------
    KeyError
        If a part is missing: another kind of solver was recorded.
    ValueError
        If a part has another size.
    """
    if "best" not in parts:
        return None
    values, joints = _doubles(parts), len(request.q)
    trajectories = [
        _trajectory(numbers, request.state_ns, joints, knot_duration_s, ramp_s)
        for name, numbers in values.items()
        if name.startswith(_TRAJECTORY)
    ]
    fields = {name: np.asarray(value) for name, value in like._asdict().items()}
    state = type(like)(**{name: _unpacked(parts[f"{_SOLVER}{name}"], it) for name, it in fields.items()})
    detour = None
    if "detour" in values:
        least, waited, number, is_on, arrived, *posture = values["detour"].tolist()
        detour = Detour(least, waited, int(number), bool(is_on), bool(arrived), np.array(posture))
    last = request._replace(goal=_goal(values["last goal"]))
    approach, plans = Approach(*values["approach"].tolist()), int(values["plans since reset"][0])
    return Memory(tuple(trajectories), last, parts["best"], state, approach, detour, plans)


def _doubles(parts: Mapping[str, NDArray[np.float32]]) -> dict[str, Array]:
    return {name: values.astype(float) for name, values in parts.items()}


def _goal_numbers(goal: Target) -> Array:
    rotation = np.zeros(0) if goal.rotation is None else np.ravel(goal.rotation)
    return np.concatenate([[goal.only_axis], goal.position, rotation])


def _goal(numbers: Array) -> Target:
    rotation = numbers[4:].reshape(3, 3) if len(numbers) > 4 else None
    return Target(numbers[1:4], rotation, bool(numbers[0]))


def _in_force(trajectories: tuple[ReferenceTrajectory, ...], state_ns: int) -> tuple[ReferenceTrajectory, ...]:
    """The trajectories that are in force at a time or later."""
    begun = [index for index, each in enumerate(trajectories) if each.effect_ns <= state_ns]
    return trajectories[max(begun, default=0) :]


def _trajectory_numbers(trajectory: ReferenceTrajectory, state_ns: int) -> Array:
    """Time from the state to the effect, ns, and the references: that before, unless it steps, and those of the knots.

    Within the horizon of a plan, whole milliseconds are exact in single precision.
    """
    knots = zip(trajectory.positions, trajectory.rotations, trajectory.postures, strict=True)
    references = [*([] if trajectory.before is None else [trajectory.before]), *knots]
    rows = [np.concatenate([np.ravel(part) for part in reference]) for reference in references]
    return np.concatenate([[trajectory.effect_ns - state_ns], *rows])


def _trajectory(
    numbers: Array, state_ns: int, joints: int, knot_duration_s: float, ramp_s: float
) -> ReferenceTrajectory:
    rows = numbers[1:].reshape(-1, _POSE + joints)
    first = 1 if ramp_s > 0.0 else 0
    positions, rotations, postures = rows[:, :3], rows[:, 3:_POSE].reshape(-1, 3, 3), rows[:, _POSE:]
    return ReferenceTrajectory(
        effect_ns=state_ns + round(numbers[0]),
        knot_duration_s=knot_duration_s,
        positions=positions[first:],
        rotations=rotations[first:],
        postures=postures[first:],
        before=HeldReference(positions[0], rotations[0], postures[0]) if first else None,
        ramp_s=ramp_s,
    )


def _packed(values: NDArray[Any]) -> NDArray[Any]:
    """Values as they are recorded: of a symmetric matrix, such as a covariance, the lower triangle."""
    is_symmetric = values.ndim == 2 and values.shape[0] == values.shape[1] and np.allclose(values, values.T)
    return values[np.tril_indices(len(values))] if is_symmetric else values


def _unpacked(numbers: NDArray[np.float32], like: NDArray[Any]) -> NDArray[Any]:
    """Recorded values with the shape and type of an array."""
    if like.ndim == 2 and numbers.size == len(like) * (len(like) + 1) // 2 != like.size:
        whole = np.zeros(like.shape)
        whole[np.tril_indices(len(like))] = numbers
        numbers = np.where(np.tri(len(like), dtype=bool), whole, whole.T)
    return numbers.reshape(like.shape).astype(like.dtype)
