"""Re-execution of the planner: any plan of a bag made again, the same within tolerances on any machine.

The bag has what each plan was made for and started from, and the solution that the solver found. Prediction, obstacles,
transfer model and cost are computed again with this solution, and compared.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping

import numpy as np

from contact_reach_ros.arm import Array
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


@dataclasses.dataclass(frozen=True)
class ReexecutedPlan:
    """A plan made again.

    Attributes
    ----------
    plan
        The plan with the recorded solution.
    statistics
        The recorded ones, by the keys of plan/statistics.
    differences
        From the recorded plan, by the names and in the units of `TOLERANCES`.
    """

    plan: Plan
    statistics: Mapping[str, str]
    differences: Mapping[str, float]

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

    best = np.zeros(0)

    def reseed(self, seed: int) -> None:
        """There is no chance."""

    def init(self, mean: FloatArray, spread: FloatArray) -> None:
        """Nothing is learned."""

    def shift(self, state: None, mean: FloatArray, spread: FloatArray, knots: int, elapsed: float) -> None:
        """Nothing was learned."""

    def solve(self, problem: Problem, state: None, start_cost: float, number: int, until: float = 0.0) -> Solution:
        """The recorded solution."""
        return Solution(self.best, 0.0, state, 1, "max_steps", (0.0,))


class RecordedPlans:
    """The plans of a bag, each with what it was made from; raises `BagError` if the bag lacks what is needed.

    Attributes
    ----------
    numbers
        Plans that can be solved again.
    """

    def __init__(self, inputs: RecordedInputs) -> None:
        self._inputs = inputs
        self._path = inputs.bag.path
        made = {number for number, *_ in self._statistics()}
        self.numbers = sorted(made.intersection(number for number, _ in self._requests()))
        if not self.numbers:
            raise BagError(
                f"bag '{self._path}': no plan can be solved again, expected plan/request beside plan/statistics: "
                "record a run in which the planner makes plans, or solve those of version 0.2 with that version"
            )
        self._settings = settings = inputs.sections("planner")
        self._solution = _RecordedSolution()
        # Results must not depend on how fast the machine is.
        planning = dataclasses.replace(settings["planning"], deadline=0.0)
        force, capacity = settings[BUDGET].permitted_force, settings[""].max_spheres
        controller = ControllerSettings.from_sections(settings)
        self._planner = RecedingHorizonPlanner(
            inputs.arm, planning, controller, force, capacity, lambda *_: self._solution
        )

    def solve(self, number: int) -> ReexecutedPlan:
        """Solve a plan again; raises `BagError` if the bag lacks the plan or what it was made from."""
        if number not in self.numbers:
            known = self.numbers
            raise BagError(
                f"bag '{self._path}' lacks plan {number}; expected one of its {len(known)} plans from {known[0]} to "
                f"{known[-1]}"
            )
        *_, (_, statistics, effect_ns) = (each for each in self._statistics() if each[0] == number)
        *_, parts = (parts for known, parts in self._requests() if known == number)
        request = read_request(parts, int(statistics["state ns"]), effect_ns)
        request = request._replace(spheres=self._obstacles(number, int(statistics["obstacles sent ns"])))
        knot_duration_s, ramp_s = self._settings["planning"].knot_duration, self._settings["impedance"].reference_ramp
        self._planner.memory = read_memory(parts, request, knot_duration_s, ramp_s)
        self._solution.best = parts["found"]
        plan = self._planner.plan(request)
        return ReexecutedPlan(plan, statistics, self._differences(plan, float(statistics["cost"]), effect_ns))

    def _statistics(self) -> Iterator[tuple[int, dict[str, str], int]]:
        """Number, statistics and time of effect, ns, of each plan."""
        for message in self._inputs.bag.messages("/plan/statistics"):
            for status in message.status:
                values = {entry.key: entry.value for entry in status.values}
                yield int(values.get("plan", "0")), values, nanoseconds(message.header.stamp)

    def _requests(self) -> Iterator[tuple[int, Parts]]:
        """Number of each plan, and what it was made from."""
        for parts in map(split_array, self._inputs.bag.messages("/plan/request")):
            if "plan" in parts:
                yield int(parts["plan"][0]), parts

    def _obstacles(self, number: int, sent_ns: int) -> Spheres:
        """The obstacles that the planner knew; `sent_ns` is 0 for none."""
        if not sent_ns:
            return Spheres.none()
        reader = ObstacleMarkerReader(self._inputs.arm.base_frame, self._settings[""])
        spheres, is_known, bag = None, False, self._inputs.bag
        for raw in bag.raw_messages(_OBSTACLES & bag.topics.keys()):
            # Obstacles may rest where they were seen first.
            if raw.publish_time_ns <= sent_ns:
                is_known |= raw.publish_time_ns == sent_ns
                with contextlib.suppress(InputError):  # as the node refused it
                    spheres = reader.read(raw.data)
        if spheres is None or not is_known:
            raise BagError(f"bag '{self._path}' lacks the obstacles of plan {number}, which were sent at {sent_ns} ns")
        return spheres

    def _differences(self, plan: Plan, cost: float, effect_ns: int) -> dict[str, float]:
        """Differences of the plan with the recorded solution, by the names of `TOLERANCES`."""
        found = dict.fromkeys(TOLERANCES, math.nan)
        found["cost"] = abs(plan.cost - cost) / max(abs(cost), _LEAST_COST)
        for message in self._inputs.bag.messages("/reference/pose"):
            if nanoseconds(message.header.stamp) == effect_ns:
                positions, rotations = read_poses(message)
                found["positions"] = _largest(positions - plan.positions)
                found["rotations"] = _largest(rotations - plan.rotations)
        for message in self._inputs.bag.messages("/reference/posture"):
            if nanoseconds(message.header.stamp) == effect_ns:
                postures = read_postures(message, self._inputs.arm.joint_names)
                found["postures"] = _largest(postures - plan.postures)
        return found


def _largest(values: Array) -> float:
    return float(np.abs(values).max())
