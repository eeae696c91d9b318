"""Re-execution of the planner: any plan of a bag made again, the same within tolerances on any machine.

The bag has what each plan was made for and started from, and the solution that the solver found. Prediction, obstacles,
transfer model and cost are computed again with this solution, and compared.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.messages.plan_reader import read_poses, read_postures
from contact_reach_ros.messages.plan_request import Parts, read_memory, read_request
from contact_reach_ros.messages.values import nanoseconds, split_array
from contact_reach_ros.observer.budget import BUDGET
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.solver.solver import FloatArray, Solution
from contact_reach_ros.planning.terms import Problem
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.world.spheres import Spheres

TOLERANCES = {"cost": 1e-4, "positions": 1e-5, "rotations": 1e-4, "postures": 1e-4}
"""Of the cost, relative, and of the references, m and rad."""

_OBSTACLES = {"/obstacles"}
_LEAST_COST = 0.1
"""Relative differences are of this cost at least: near the goal it is the rounding of a few positions."""


class ReexecutedPlan(NamedTuple):
    """A plan made again, with the recorded solution."""

    plan: Plan
    statistics: Mapping[str, str]
    """The recorded ones, by the keys of plan/statistics."""
    differences: Mapping[str, float]
    """From the recorded plan, by the names and in the units of `TOLERANCES`."""

    @property
    def exceeded(self) -> str:
        """What differs by more than its tolerance, in words; empty if nothing does."""
        # Not `>`: what is not a number exceeds it, too.
        return ", ".join(
            f"{name} by {value:.2g} (tolerance {TOLERANCES[name]:g})"
            for name, value in self.differences.items()
            if not value <= TOLERANCES[name]
        )


class _RecordedSolution:
    """Stands in for a solver: its searches end at once, with the recorded solution."""

    def __init__(self, best: Array) -> None:
        """`best`: (N,) the plan as a point of the solver's box."""
        self._best = best

    def reseed(self, seed: int) -> None:
        """There is no chance."""

    def solve(
        self, problem: Problem, start: FloatArray, start_cost: float, number: int, until: float = 0.0
    ) -> Solution:
        """The recorded solution."""
        return Solution(self._best, 0.0, 1, "max_steps", (0.0,))


def solve_again(inputs: RecordedInputs, number: int) -> ReexecutedPlan:
    """Solve a plan again; raises `BagError` if the bag lacks the plan or what it was made from."""
    bag, settings = inputs.bag, inputs.sections("planner")
    statistics, effect_ns, parts = _recorded(bag, number)
    request = read_request(parts, int(statistics["state ns"]), effect_ns)
    reader = ObstacleMarkerReader(inputs.arm.base_frame, settings[""])
    request = request._replace(spheres=_obstacles(bag, reader, number, int(statistics["obstacles sent ns"])))
    # Results must not depend on how fast the machine is.
    planning = dataclasses.replace(settings["planning"], deadline=0.0)
    force, capacity = settings[BUDGET].permitted_force, settings[""].max_spheres
    controller = ControllerSettings.from_sections(settings)
    solution = _RecordedSolution(parts["found"])
    planner = RecedingHorizonPlanner(inputs.arm, planning, controller, force, capacity, lambda *_: solution)
    planner.memory = read_memory(parts, request, planning.knot_duration, settings["impedance"].reference_ramp)
    plan = planner.plan(request)
    return ReexecutedPlan(plan, statistics, _differences(bag, inputs.arm, plan, float(statistics["cost"]), effect_ns))


def _recorded(bag: BagReader, number: int) -> tuple[dict[str, str], int, Parts]:
    """Statistics of a plan, when it took effect, ns, and what it was made from."""
    made: dict[int, tuple[dict[str, str], int]] = {}
    requested: dict[int, Parts] = {}
    for message in bag.messages("/plan/statistics"):
        for status in message.status:
            values = {entry.key: entry.value for entry in status.values}
            made[int(values.get("plan", "0"))] = values, nanoseconds(message.header.stamp)
    for parts in map(split_array, bag.messages("/plan/request")):
        if "plan" in parts:
            requested[int(parts["plan"][0])] = parts
    known = sorted(made.keys() & requested)
    if not known:
        raise BagError(
            f"bag '{bag.path}': no plan can be solved again, expected plan/request beside plan/statistics: "
            "record a run in which the planner makes plans, or solve those of version 0.2 with that version"
        )
    if number not in known:
        raise BagError(
            f"bag '{bag.path}' lacks plan {number}; expected one of its {len(known)} plans from {known[0]} to "
            f"{known[-1]}"
        )
    return *made[number], requested[number]


def _obstacles(bag: BagReader, reader: ObstacleMarkerReader, number: int, sent_ns: int) -> Spheres:
    """The obstacles that the planner knew; `sent_ns` is 0 for none."""
    if not sent_ns:
        return Spheres.none()
    spheres, is_known = None, False
    for raw in bag.raw_messages(_OBSTACLES & bag.topics.keys()):
        # Obstacles may rest where they were seen first.
        if raw.publish_time_ns <= sent_ns:
            is_known |= raw.publish_time_ns == sent_ns
            with contextlib.suppress(InputError):  # as the node refused it
                spheres = reader.read(raw.data)
    if spheres is None or not is_known:
        raise BagError(f"bag '{bag.path}' lacks the obstacles of plan {number}, which were sent at {sent_ns} ns")
    return spheres


def _differences(bag: BagReader, arm: Arm, plan: Plan, cost: float, effect_ns: int) -> dict[str, float]:
    """Differences of the plan with the recorded solution, by the names of `TOLERANCES`."""
    found = dict.fromkeys(TOLERANCES, math.nan)
    found["cost"] = abs(plan.cost - cost) / max(abs(cost), _LEAST_COST)
    for message in bag.messages("/reference/pose"):
        if nanoseconds(message.header.stamp) == effect_ns:
            positions, rotations = read_poses(message)
            found["positions"] = _largest(positions - plan.positions)
            found["rotations"] = _largest(rotations - plan.rotations)
    for message in bag.messages("/reference/posture"):
        if nanoseconds(message.header.stamp) == effect_ns:
            found["postures"] = _largest(read_postures(message, arm.joint_names) - plan.postures)
    return found


def _largest(values: Array) -> float:
    return float(np.abs(values).max())
