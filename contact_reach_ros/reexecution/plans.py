"""Re-execution of the planner: any plan of a bag solved again, bit for bit on the machine that made it.

Other processors round differently: there it is equal within `ROUNDING`.

What a plan depends on is in the bag: the state and the moment of its effect, the goal and the obstacles that the
planner knew then, the plans before it, and where the solver ended with the last one. That last part is large and is
kept for every tenth plan only; the plans in between are solved again on the way.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.messages.goals import to_goal
from contact_reach_ros.messages.intake import TOPICS, Taken
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial, ObstacleMarkerReader
from contact_reach_ros.messages.safety_state import is_stopped, read_contact
from contact_reach_ros.messages.values import nanoseconds, split_array
from contact_reach_ros.planning.memory import PLANS_KEPT, History, Memory
from contact_reach_ros.planning.patience import Approach
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.plan_record import (
    SPEED,
    before_in,
    detour_in,
    is_keyframe,
    plan_statistics,
    solution_parts,
    state_in,
)
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.unexpected_contact import RETREAT_TO, ContactReaction
from contact_reach_ros.reexecution.inputs import RecordedInputs, Row
from contact_reach_ros.reexecution.plan_outcome import ROUNDING, PlanDifference, ReexecutedPlan, compare_plans
from contact_reach_ros.reexecution.settings import BUDGET, ChangedSettings

_ONE_THREAD = "OPENBLAS_NUM_THREADS"

_log = logging.getLogger(__name__)


class RecordedPlans:
    """The plans of a bag, and what each of them was made from; raises `BagError` if the bag lacks what is needed.

    Attributes
    ----------
    requests
        What each plan was solved for, by its number.
    statistics
        The recorded statistics of each plan, by its number.
    """

    def __init__(self, inputs: RecordedInputs) -> None:
        self._inputs = inputs
        path = inputs.bag.summary.path
        if "planner" not in inputs.intakes or "planner" not in inputs.settings:
            raise BagError(f"bag '{path}' lacks intake/planner or the planner's settings: plans cannot be re-executed")
        self.statistics, self._effects, self._solutions = _read_plans(inputs)
        if not self.statistics:
            raise BagError(f"bag '{path}' has no plans, or lacks plan/statistics")
        if any("approach" not in parts for parts in self._solutions.values()):
            raise BagError(
                f"bag '{path}' was recorded by an earlier version, whose planner weighed contact differently: plans "
                "cannot be re-executed; use that version"
            )
        if os.environ.get(_ONE_THREAD) != "1":
            _log.warning(
                "%s is not 1, as it was for the planner: plans among deformable bodies may differ in the last digits; "
                "set it before Python starts",
                _ONE_THREAD,
            )
        self._settings = inputs.sections("planner")
        self._arm = inputs.arm_of("planner")
        self.requests = self._find_requests()
        self._planner: RecedingHorizonPlanner | None = None

    @property
    def numbers(self) -> list[int]:
        """Plans that can be re-executed."""
        return [number for number in self.requests if self._start_of(number) is not None]

    def solve(self, number: int, changes: ChangedSettings | None = None) -> ReexecutedPlan:
        """Solve a plan again; raises `BagError` if the bag lacks the plan or what it was made from.

        Parameters
        ----------
        number
            Of the plan, as in plan/statistics.
        changes
            Changed settings for it, but not for those on the way.
        """
        start = self._start_of(number) if number in self.requests else None
        if start is None:
            known = self.numbers
            had = f"those from {known[0]} to {known[-1]} can be" if known else "none can be"
            raise BagError(
                f"bag '{self._inputs.bag.summary.path}': plan {number} cannot be re-executed: it, its state or what it "
                f"started from is not recorded; {had}"
            )
        began = time.perf_counter()
        if self._planner is None:
            self._planner = self._make_planner(self._settings)
        planner = self._planner
        if not self._is_first(start):
            planner.go_on_from(self._history(start - 1, planner))
        difference: PlanDifference | None = None
        rounding = 0.0
        for current in range(start, number + (0 if changes else 1)):
            if self._is_first(current):
                planner.reset()
            plan = self._solve(planner, current)
            if difference is None:
                difference, rounded = self._compare(plan, planner, current, ROUNDING * (current - start + 1))
                rounding = max(rounding, rounded)
        if changes:
            changed = self._make_planner(changes.apply("planner", self._settings))
            if planner.memory is not None and not self._is_first(number) and changed.size == planner.size:
                changed.go_on_from(planner.history())
            plan = self._solve(changed, number)
        seconds = time.perf_counter() - began
        return ReexecutedPlan(number, plan, self.statistics[number], number - start + 1, difference, rounding, seconds)

    def _solve(self, planner: RecedingHorizonPlanner, number: int) -> Plan:
        """Plan with as many steps as there was time for."""
        statistics = self.statistics[number]
        stopped_by_clock = statistics.get("stop reason") == "deadline"
        planner.limit_steps(int(statistics["steps"]) if stopped_by_clock else None)
        return planner.plan(self.requests[number])

    def _make_planner(self, settings: Mapping[str, Any]) -> RecedingHorizonPlanner:
        # The recorded number of steps stands for the deadline.
        planning = dataclasses.replace(settings["planning"], deadline=0.0)
        force = settings[BUDGET].permitted_force
        return RecedingHorizonPlanner(self._arm, planning, settings["impedance"], force, settings[""].max_spheres)

    def _is_first(self, number: int) -> bool:
        """Whether the planner had forgotten the plans before this one."""
        return int(self.statistics[number]["plans since reset"]) == 0

    def _start_of(self, number: int) -> int | None:
        """The plan to begin with so as to get to one; None if what it started from is not known."""
        while number in self.requests:
            if self._is_first(number):
                return number
            if number - 1 in self.requests and is_keyframe(self._solutions.get(number - 1, {})):
                return number
            number -= 1
        return None

    def _history(self, number: int, planner: RecedingHorizonPlanner) -> History:
        first = number
        while first - 1 in self._solutions and number - first < PLANS_KEPT - 1 and not self._is_first(first):
            first -= 1
        plans = tuple(self._plan(earlier) for earlier in range(first, number + 1))
        request, parts = self.requests[number], self._solutions[number]
        state, approach = state_in(parts, planner.fresh_state), Approach(*parts["approach"].tolist())
        memory = Memory(plans[-1], request.goal, parts["best"], state, approach, detour_in(parts))
        since_reset = int(self.statistics[number]["plans since reset"]) + 1
        return History(plans, memory, (request.state_ns, request.q), since_reset, number)

    def _plan(self, number: int) -> Plan:
        """A recorded plan, as far as later ones need it."""
        parts, statistics = self._solutions[number], self.statistics[number]
        nothing = np.zeros(0)
        return Plan(
            number=number,
            effect_ns=self._effects[number],
            knot_duration_s=self._settings["planning"].knot_duration,
            positions=parts["positions"].reshape(-1, 3).astype(float),
            rotations=parts["rotations"].reshape(-1, 3, 3).astype(float),
            postures=parts["postures"].reshape(-1, self._arm.n).astype(float),
            predicted_q=nothing,
            predicted_positions=nothing,
            predicted_contact_forces=nothing,
            cost=float(statistics["cost"]),
            cost_terms={},
            steps=int(statistics["steps"]),
            stop_reason=statistics["stop reason"],
            solve_s=0.0,
            rejected=0,
            left_out=0,
            before=before_in(parts),
            ramp_s=self._settings["impedance"].reference_ramp,
        )

    def _compare(
        self, plan: Plan, planner: RecedingHorizonPlanner, number: int, rounding: float
    ) -> tuple[PlanDifference | None, float]:
        """As `compare_plans`."""
        statistics, parts = self.statistics[number], self._solutions.get(number)
        found = plan_statistics(plan)
        recorded = {field: np.array([float(statistics.get(field, "nan"))]) for field in found}
        now = {field: np.array([float(value)]) for field, value in found.items()}
        if parts is not None and planner.memory is not None:
            recorded |= {field: values.astype(float) for field, values in parts.items()}
            solution = solution_parts(plan, planner.memory)
            now |= {field: values.ravel().astype(float) for field, values in solution.items()}
        return compare_plans(number, recorded, now, rounding)

    def _find_requests(self) -> dict[int, Request]:
        """Pass on everything that the planner took in to a planner without a core; returns its requests by plan."""
        settings, arm = self._settings, self._arm
        obstacles = ObstacleMarkerReader(arm.base_frame, AssumedMaterial.of(settings[""]))
        stiffness, sees = settings["planning"].contact_stiffness, settings[""].max_spheres > 0
        reaction = ContactReaction(arm, settings["unexpected_contact"], stiffness, sees)
        planner = Planner(arm, None, reaction, settings[""], refuse=lambda *_: None, task=settings["impedance"].task)
        requests: dict[int, Request] = {}
        for row in self._inputs.intakes["planner"]:
            try:
                request = self._take(planner, obstacles, row)
            except InputError:
                # As the node refused it.
                continue
            if request is not None and row.gave_output and row.output in self.statistics:
                statistics = self.statistics[row.output]
                requests[row.output] = request._replace(
                    effect_ns=self._effects[row.output],
                    # It may have been changed from plan to plan.
                    speed_scale=float(statistics.get(SPEED, 1.0)),
                    detours=RETREAT_TO not in statistics,
                )
        return requests

    def _take(self, planner: Planner, obstacles: ObstacleMarkerReader, row: Row) -> Request | None:
        """Pass on one message or call."""
        inputs = self._inputs
        if row.what in (Taken.ACTIVATE, Taken.STOP):
            planner.withdraw()
        if row.what is Taken.JOINT_STATES:
            state = inputs.state(row.sent_ns)
            return None if state is None else planner.request(state)
        message = inputs.message(row.what, row.sent_ns) if row.what in TOPICS else None
        if message is None:
            return None
        if row.what is Taken.OBSTACLES:
            spheres = obstacles.read(message)
            planner.see(spheres, obstacles.stamp_ns)
        elif row.what is Taken.GOAL_POSE:
            planner.command(to_goal(message, self._settings[""]))
        elif row.what is Taken.SAFETY_STATE and planner.goal is not None:
            if is_stopped(message):
                planner.withdraw()
            elif message.name == "observer":
                planner.touched(read_contact(message, inputs.arm))
        return None


def _read_plans(
    inputs: RecordedInputs,
) -> tuple[dict[int, dict[str, str]], dict[int, int], dict[int, dict[str, NDArray[np.float32]]]]:
    """Statistics, time of effect and solution of each plan, by its number."""
    statistics: dict[int, dict[str, str]] = {}
    effects: dict[int, int] = {}
    solutions: dict[int, dict[str, NDArray[np.float32]]] = {}
    for message in inputs.messages("plan/statistics"):
        for status in message.status:
            values = {entry.key: entry.value for entry in status.values}
            number = int(values.get("plan", "0"))
            statistics[number], effects[number] = values, nanoseconds(message.header.stamp)
    for message in inputs.messages("plan/solution"):
        parts = split_array(message)
        if "plan" in parts:
            solutions[int(parts["plan"][0])] = parts
    return statistics, effects, solutions
