"""The message plan/request: what a plan was made for, started from and came to, so that it can be made again.

It is a std_msgs/Float64MultiArray whose dimensions name the parts one after the other. The times of state and effect,
and the obstacles that the planner knew, are in plan/statistics.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.control.references import Reference
from contact_reach_ros.planning.detour import Detour
from contact_reach_ros.planning.plan import ReferenceTrajectory, Request
from contact_reach_ros.planning.receding_horizon import Memory
from contact_reach_ros.planning.terms import Approach
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

Parts = Mapping[str, Array]

_POSE = 12
"""Numbers of a position and a rotation."""

_TRAJECTORY = "trajectory "
"""Prefix of the trajectories that may be in force until the plan takes effect."""


def request_parts(number: int, request: Request, memory: Memory | None, found: Array) -> Parts:
    """The parts of the message of a plan.

    Parameters
    ----------
    number
        Of the plan.
    request
        What it was made for.
    memory
        What it started from; None after a reset.
    found
        (N,) the plan as a point of the solver's box.
    """
    parts = {
        "plan": np.array([number]),
        "q": request.q,
        "v": request.v,
        "goal": _goal_numbers(request.goal),
        "speed scale": np.array([request.speed_scale]),
        "found": found,
    }
    if request.holds:
        parts["holds"] = np.ones(1)
    if request.rest is not None:
        parts["rest"] = request.rest
    if memory is not None:
        parts["plans since reset"] = np.array([memory.plans])
        parts["last goal"] = _goal_numbers(memory.request.goal)
        parts["last effect"] = np.array([memory.request.effect_ns - request.state_ns])
        parts["best"] = memory.best
        position, share, rotation = memory.approach
        parts["approach"] = np.array([*position, share, *(() if rotation is None else np.ravel(rotation))])
        detour = memory.request.detour
        if detour is not None:
            progress = detour.waited, detour.number, detour.is_on
            parts["detour"] = np.array([*progress, *detour.nearest, *np.ravel(detour.postures)])
            parts["detour path"] = detour.path
        for index, trajectory in enumerate(_in_force(memory.trajectories, request.state_ns)):
            parts[f"{_TRAJECTORY}{index}"] = _trajectory_numbers(trajectory, request.state_ns)
    return {name: np.ravel(values).astype(float) for name, values in parts.items()}


def read_request(parts: Parts, state_ns: int, effect_ns: int) -> Request:
    """The request for a state and an effect at these times, ns, without obstacles."""
    goal, scale = _goal(parts["goal"]), float(parts["speed scale"][0])
    rest = parts["rest"].reshape(3, 3) if "rest" in parts else None
    return Request(
        parts["q"], parts["v"], state_ns, effect_ns, goal, Spheres.none(), scale, holds="holds" in parts, rest=rest
    )


def read_memory(parts: Parts, request: Request, knot_duration_s: float, ramp_s: float) -> Memory | None:
    """What the plan started from, without the solver's state; None after a reset.

    Parameters
    ----------
    parts
        Of the message.
    request
        The request in it.
    knot_duration_s, ramp_s
        Of the trajectories, s.
    """
    if "best" not in parts:
        return None
    trajectories = tuple(
        _trajectory(numbers, request.state_ns, len(request.q), knot_duration_s, ramp_s)
        for name, numbers in parts.items()
        if name.startswith(_TRAJECTORY)
    )
    detour = None
    if "detour" in parts:
        waited, number, is_on, *numbers = parts["detour"].tolist()
        nearest, *postures = np.reshape(numbers, (-1, len(request.q)))
        path = np.reshape(parts.get("detour path", postures[-1]), (-1, len(request.q)))
        detour = Detour(nearest, waited, int(number), bool(is_on), np.array(postures), path)
    effect_ns = request.state_ns + int(parts["last effect"][0])
    last = request._replace(effect_ns=effect_ns, goal=_goal(parts["last goal"]), detour=detour)
    position, share, rotation = np.split(parts["approach"], [3, 4])
    # Bags of 0.2 lack the rotation.
    approach = Approach(position, float(share[0]), rotation.reshape(3, 3) if rotation.size else None)
    plans = int(parts["plans since reset"][0])
    return Memory(trajectories, last, parts["best"], approach, plans)


def _goal_numbers(goal: Target) -> Array:
    rotation = np.zeros(0) if goal.rotation is None else np.ravel(goal.rotation)
    return np.concatenate([[goal.only_axis], goal.position, goal.velocity, rotation])


def _goal(numbers: Array) -> Target:
    rotation = numbers[7:].reshape(3, 3) if len(numbers) > 7 else None
    return Target(numbers[1:4], rotation, bool(numbers[0]), numbers[4:7])


def _in_force(trajectories: tuple[ReferenceTrajectory, ...], state_ns: int) -> tuple[ReferenceTrajectory, ...]:
    """The trajectories that are in force at a time or later."""
    begun = [index for index, each in enumerate(trajectories) if each.effect_ns <= state_ns]
    return trajectories[max(begun, default=0) :]


def _trajectory_numbers(trajectory: ReferenceTrajectory, state_ns: int) -> Array:
    """Time from the state to the effect, ns; the reference before, unless it steps; and the references of the knots."""
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
        before=Reference(positions[0], rotations[0], postures[0]) if first else None,
        ramp_s=ramp_s,
    )
