"""What is measured of one episode."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.episode_result import EpisodeResult
from contact_reach_ros.arm import Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings, steady_speed
from contact_reach_ros.simulation.plant import TICK

_END_TICKS = 10


@dataclass(frozen=True)
class EpisodeMetrics:
    """Figures of one episode, from the moment the goal was given until it was reached or the episode ended.

    Attributes
    ----------
    reached
        Whether the goal was reached in time, and the tip had settled there if the episode asked for that, and nothing
        stopped the arm.
    success
        Whether the goal settled, as the planner reports it, and no link ever felt more than the permitted force.
    time
        Until the goal was reached, s; None if it was not.
    entry_time
        Until the tip was first at the goal, at whatever speed, s; None if it never was.
    time_ratio
        `time` over the least time that the bound γ on Δx permits, see `least_duration`.
    max_contact_force
        Largest force on any one body of the arm, N, from the simulation.
    mean_contact_force
        Mean over time of the largest force on one body, N.
    contact_impulse
        Integral over time of the largest force on one body, N s.
    over_budget
        Time in which that force was above the permitted one, s.
    max_external_torque
        Largest magnitude of the observer's residual on any joint, Nm. What observer and controller do not know of the
        arm, such as friction, is part of it, as on a real robot.
    path_length
        Of the tip, m.
    path_ratio
        `path_length` over the distance between the ends of the path; None if the goal was not reached.
    end_error
        Distance from the target at the end, m; None if the episode ended at once.
    end_speed
        Of the tip over the last 10 ms, m/s: a goal counts as reached when the tip is near, even if it passes by.
    stop_reason, failure
        As in `EpisodeResult`.
    plans, solver_steps
        Number of plans, and of solver steps in all of them.
    """

    reached: bool
    success: bool
    time: float | None
    entry_time: float | None
    time_ratio: float | None
    max_contact_force: float
    mean_contact_force: float
    contact_impulse: float
    over_budget: float
    max_external_torque: float
    path_length: float
    path_ratio: float | None
    end_error: float | None
    end_speed: float | None
    stop_reason: str
    failure: str
    plans: int
    solver_steps: int


def measure(
    result: EpisodeResult, target: Array, planning: PlanningSettings, gains: ImpedanceSettings, permitted_force: float
) -> EpisodeMetrics:
    """The figures of an episode.

    Parameters
    ----------
    result
        Of the episode.
    target
        (3,), m.
    planning, gains
        What bounds the speed of the tip.
    permitted_force
        ε of the contact budget, N.
    """
    time = result.time if result.reached else None
    path = np.concatenate([result.start_position[None], result.positions])
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    straight = float(np.linalg.norm(path[-1] - path[0]))
    forces = result.contact_forces if len(result.positions) else np.zeros(1)
    return EpisodeMetrics(
        reached=result.reached,
        success=result.reached and bool(np.isfinite(result.settled)) and float(forces.max()) <= permitted_force,
        time=time,
        entry_time=result.duration if np.isfinite(result.duration) else None,
        time_ratio=None if time is None else time / least_duration(result.start_position, target, planning, gains),
        max_contact_force=float(forces.max()),
        mean_contact_force=float(forces.mean()),
        contact_impulse=float(forces.sum()) * TICK,
        over_budget=int((forces > permitted_force).sum()) * TICK,
        max_external_torque=float(np.abs(result.external_torques).max(initial=0.0)),
        path_length=length,
        path_ratio=length / straight if result.reached and straight > 0.0 else None,
        end_error=float(result.distances[-1]) if len(result.distances) else None,
        end_speed=_end_speed(result.positions),
        stop_reason=result.stop_reason,
        failure=result.failure,
        plans=len(result.plans),
        solver_steps=sum(plan.steps for plan in result.plans),
    )


def _end_speed(positions: Array) -> float | None:
    if len(positions) <= _END_TICKS:
        return None
    return float(np.linalg.norm(positions[-1] - positions[-1 - _END_TICKS])) / (_END_TICKS * TICK)


def least_duration(
    start_position: Array, target: Array, planning: PlanningSettings, impedance: ImpedanceSettings
) -> float:
    """Shortest time in which the flange can move from one position (3,) to another, m, base frame; in s.

    The axis with the farthest to go determines it, at `steady_speed`; infinite without stiffness, unless the distance
    is zero.
    """
    distance = float(np.abs(target - start_position).max())
    if distance == 0.0:
        return 0.0
    speed = steady_speed(planning, impedance)
    return distance / speed if speed > 0.0 else math.inf
