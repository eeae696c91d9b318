"""Re-execution of the planner: any plan of a bag solved again, the same within tolerances on any machine.

The bag has what each plan was made for and started from. Processors round differently, and a search with other rounding
may choose other candidates that are as good: costs and references are compared within tolerances.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial, ObstacleMarkerReader
from contact_reach_ros.messages.plan_request import Parts, read_memory, read_request
from contact_reach_ros.messages.references import pose_knots, posture_knots
from contact_reach_ros.messages.values import nanoseconds, split_array
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.reexecution.inputs import OBSTACLES, RecordedInputs
from contact_reach_ros.reexecution.settings import BUDGET, ChangedSettings
from contact_reach_ros.world.spheres import Spheres

TOLERANCES = {"cost": 1e-4, "positions": 2e-4, "rotations": 4e-3, "postures": 4e-3}
"""Of the cost, relative, and of the references, m and rad: 2 % of γ."""


@dataclasses.dataclass(frozen=True)
class ReexecutedPlan:
    """A plan solved again.

    Attributes
    ----------
    plan
        The re-executed plan.
    statistics
        The recorded ones, by the keys of plan/statistics.
    differences
        From the recorded plan, by the names and in the units of `TOLERANCES`; none with changed settings.
    exceeded
        What differs by more than its tolerance, in words; empty if nothing does.
    seconds
        Wall-clock time.
    """

    plan: Plan
    statistics: Mapping[str, str]
    differences: Mapping[str, float]
    exceeded: str
    seconds: float


class RecordedPlans:
    """The plans of a bag, each with what it was made from; raises `BagError` if the bag lacks what is needed.

    Attributes
    ----------
    statistics
        The recorded statistics of each plan, by its number.
    """

    def __init__(self, inputs: RecordedInputs) -> None:
        self._inputs = inputs
        self._path = inputs.bag.summary.path
        self.statistics: dict[int, dict[str, str]] = {}
        self._effects: dict[int, int] = {}
        for message in inputs.messages("plan/statistics"):
            for status in message.status:
                values = {entry.key: entry.value for entry in status.values}
                number = int(values.get("plan", "0"))
                self.statistics[number], self._effects[number] = values, nanoseconds(message.header.stamp)
        requests = (split_array(message) for message in inputs.messages("plan/request"))
        self._requests: dict[int, Parts] = {int(parts["plan"][0]): parts for parts in requests if "plan" in parts}
        if not self.numbers:
            earlier = "an earlier version recorded it, which can solve them: use that version"
            raise BagError(
                f"bag '{self._path}': no plan can be solved again, expected plan/request beside plan/statistics; "
                + (earlier if self.statistics else "record a run in which the planner made plans")
            )
        self._settings = inputs.sections("planner")
        self._arm = inputs.arm_of("planner")

    @property
    def numbers(self) -> list[int]:
        """Plans that can be solved again."""
        return sorted(set(self.statistics) & set(self._requests))

    def solve(self, number: int, changes: ChangedSettings | None = None) -> ReexecutedPlan:
        """Solve a plan again, with changed settings if there are any.

        Raises
        ------
        BagError
            If the bag lacks the plan or what it was made from.
        SettingsError
            If changed settings are not accepted.
        """
        if number not in self.numbers:
            known = self.numbers
            raise BagError(
                f"bag '{self._path}' lacks plan {number}; expected one of its {len(known)} plans from {known[0]} to "
                f"{known[-1]}"
            )
        began = time.perf_counter()
        statistics = self.statistics[number]
        planning = self._settings["planning"]
        planner = self._make_planner(changes.apply("planner", self._settings)) if changes else self._planner
        steps = int(statistics["steps"])
        request, recorded = self._request(number), self._requests[number]
        try:
            ramp_s = self._settings["impedance"].reference_ramp
            memory = read_memory(recorded, request, planner.fresh_state, planning.knot_duration, ramp_s)
        except (KeyError, ValueError) as error:
            if not changes:
                raise BagError(f"bag '{self._path}': plan {number} started from another solver: {error}") from error
            memory = None
        planner.memory = memory
        # With changed settings the search ends by its own rule, unless the clock ended it.
        planner.limit_steps(None if changes and statistics["stop reason"] != "deadline" else steps)
        plan = planner.plan(request)
        differences = {} if changes else self._differences(plan, number)
        return ReexecutedPlan(plan, statistics, differences, _exceeded(differences), time.perf_counter() - began)

    @functools.cached_property
    def _planner(self) -> RecedingHorizonPlanner:
        """Takes as many steps as were recorded, since rounding may decide whether the last one still counts."""
        planning = dataclasses.replace(self._settings["planning"], stagnation_tolerance=0.0)
        return self._make_planner(self._settings | {"planning": planning})

    def _make_planner(self, settings: Mapping[str, Any]) -> RecedingHorizonPlanner:
        # The recorded number of steps stands for the deadline.
        planning = dataclasses.replace(settings["planning"], deadline=0.0)
        force, capacity = settings[BUDGET].permitted_force, settings[""].max_spheres
        reach = settings["supervision"].max_position_error
        return RecedingHorizonPlanner(self._arm, planning, settings["impedance"], force, capacity, reach)

    def _request(self, number: int) -> Request:
        """What a plan was made for."""
        statistics = self.statistics[number]
        request = read_request(self._requests[number], (int(statistics["state ns"]), self._effects[number]))
        return request._replace(spheres=self._obstacles(number, int(statistics["obstacles sent ns"])))

    def _obstacles(self, number: int, sent_ns: int) -> Spheres:
        """The obstacles that the planner knew; `sent_ns` is 0 for none."""
        if not sent_ns:
            return Spheres.none()
        reader = ObstacleMarkerReader(self._arm.base_frame, AssumedMaterial.of(self._settings[""]))
        spheres = None
        # Obstacles may rest where they were seen first.
        for data in self._inputs.data_until(OBSTACLES, sent_ns):
            with contextlib.suppress(InputError):  # as the node refused it
                spheres = reader.read(data)
        if spheres is None:
            raise BagError(f"bag '{self._path}' lacks the obstacles of plan {number}, which were sent at {sent_ns} ns")
        return spheres

    def _differences(self, plan: Plan, number: int) -> dict[str, float]:
        """Differences from the recorded plan, as `ReexecutedPlan.differences`."""
        cost, effect_ns = float(self.statistics[number]["cost"]), self._effects[number]
        found = {"cost": abs(plan.cost - cost) / max(abs(cost), 1e-9)}
        for message in self._inputs.messages("reference/pose"):
            if nanoseconds(message.header.stamp) == effect_ns:
                poses = pose_knots(message)
                found["positions"] = _largest(poses.positions - plan.positions)
                found["rotations"] = _largest(poses.rotations - plan.rotations)
        for message in self._inputs.messages("reference/posture"):
            if nanoseconds(message.header.stamp) == effect_ns:
                knots = posture_knots(message, self._arm.joint_names)
                found["postures"] = _largest(knots.postures - plan.postures)
        return found


def _largest(values: Array) -> float:
    return float(np.abs(values).max())


def _exceeded(differences: Mapping[str, float]) -> str:
    """What differs by more than its tolerance, in words."""
    # Not `>`: what is not a number exceeds it, too.
    return ", ".join(
        f"{name} by {value:.2g} (tolerance {TOLERANCES[name]:g})"
        for name, value in differences.items()
        if not value <= TOLERANCES[name]
    )
