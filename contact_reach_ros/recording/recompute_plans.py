"""Re-execution of the planner: any plan of a bag solved again, bit for bit on the machine that made it.

What a plan depends on is in the bag: the state and the moment of its effect, the goal and the obstacles that the
planner knew then, the plans before it, and where the solver ended with the last one. That last part is large and is
kept for every tenth plan only; the plans in between are solved again on the way.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.planning.goal import make_goal
from contact_reach_ros.planning.patience import Approach
from contact_reach_ros.planning.problem import Goal, Plan, Spheres
from contact_reach_ros.planning.receding_horizon import History, Memory, RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.unexpected_contact import ContactReaction, UnexpectedContactSettings
from contact_reach_ros.recording.intake import Taken
from contact_reach_ros.recording.plan_record import distribution_of
from contact_reach_ros.recording.recompute import Other
from contact_reach_ros.recording.recorded_inputs import RecordedInputs
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_IN_FORCE = 16
"""Plans that a planner remembers."""
_SOLUTION = ("positions", "rotations", "postures", "best", "approach")


class Request(NamedTuple):
    """What the planner was asked."""

    q: Array
    v: Array
    state_ns: int
    effect_ns: int
    goal: Goal
    spheres: Spheres
    afresh: bool
    """Whether it had forgotten the plans before."""


class PlanDifference(NamedTuple):
    """Where a plan differs from the recorded one."""

    plan: int
    field: str
    recorded: float | str
    recomputed: float | str

    def __str__(self) -> str:
        return f"plan {self.plan}, {self.field}: recorded {self.recorded}, recomputed {self.recomputed}"


@dataclasses.dataclass(frozen=True)
class PlanRerun:
    """A plan solved again.

    Attributes
    ----------
    number :
        Of the plan.
    plan :
        As it comes out now.
    statistics :
        What the bag says about it.
    solved :
        How many plans were solved on the way, this one included.
    first_difference :
        Of all of these; None if there is none. With other settings nothing is compared.
    seconds :
        Time on the wall.
    """

    number: int
    plan: Plan
    statistics: Mapping[str, str]
    solved: int
    first_difference: PlanDifference | None
    seconds: float


class RecordedPlans:
    """The plans of a bag, and what each of them was made from.

    Raises
    ------
    BagError
        If the bag lacks what is needed.
    """

    def __init__(self, inputs: RecordedInputs) -> None:
        self._inputs = inputs
        path = inputs.bag.summary.path
        if "planner" not in inputs.intakes or "planner" not in inputs.settings:
            raise BagError(f"bag '{path}' lacks intake/planner or the planner's settings: plans cannot be made again")
        self.statistics, self._effects, self._solutions = _read_plans(inputs)
        if not self.statistics:
            raise BagError(f"bag '{path}' has no plans, or lacks plan/statistics")
        if any("approach" not in parts for parts in self._solutions.values()):
            raise BagError(
                f"bag '{path}' was recorded by an earlier version, whose planner weighed contact differently: plans "
                "cannot be made again; use that version"
            )
        self.requests = self._follow_the_node()
        self._planner: RecedingHorizonPlanner | None = None

    @property
    def numbers(self) -> list[int]:
        """Plans that can be made again."""
        return [number for number in self.requests if self._start_of(number) is not None]

    def solve(self, number: int, other: Other | None = None) -> PlanRerun:
        """Make a plan again.

        Parameters
        ----------
        number
            Of the plan, as in plan/statistics.
        other
            Other settings for it, but not for those on the way.

        Raises
        ------
        BagError
            If the bag lacks the plan or what it was made from.
        """
        start = self._start_of(number) if number in self.requests else None
        if start is None:
            known = self.numbers
            had = f"those from {known[0]} to {known[-1]} can be" if known else "none can be"
            raise BagError(
                f"bag '{self._inputs.bag.summary.path}': plan {number} cannot be made again: it, its state or what it "
                f"started from is not recorded; {had}"
            )
        began = time.perf_counter()
        if self._planner is None:
            self._planner = self._make_planner(Other())
        planner = self._planner
        history = self._history(start - 1) if not self.requests[start].afresh else None
        if history is not None:
            planner.go_on_from(history)
        difference: PlanDifference | None = None
        for current in range(start, number + (0 if other else 1)):
            plan = self._make(planner, current)
            difference = difference or self._compare(plan, planner, current)
        if other:
            plan = self._make_with(planner, number, other)
        return PlanRerun(
            number, plan, self.statistics[number], number - start + 1, difference, time.perf_counter() - began
        )

    def _make(self, planner: RecedingHorizonPlanner, number: int) -> Plan:
        if self.requests[number].afresh:
            planner.reset()
        return self._plan_as_then(planner, number)

    def _plan_as_then(self, planner: RecedingHorizonPlanner, number: int) -> Plan:
        """Plan with as many steps as there was time for."""
        statistics = self.statistics[number]
        stopped_by_clock = statistics.get("stop reason") == "deadline"
        planner.limit_steps(int(statistics["steps"]) if stopped_by_clock else None)
        return planner.plan(*self.requests[number][:6])

    def _make_with(self, planner: RecedingHorizonPlanner, number: int, other: Other) -> Plan:
        """The plan with other settings, from the same start as far as they permit."""
        changed, memory = self._make_planner(other), planner.memory
        request = self.requests[number]
        if memory is not None and not request.afresh and changed.size == planner.size:
            changed.go_on_from(planner.history())
        return self._plan_as_then(changed, number)

    def _make_planner(self, other: Other) -> RecedingHorizonPlanner:
        inputs = self._inputs
        planning = other.section(inputs, "planner", "planning", PlanningSettings)
        told = {**inputs.settings["planner"], **other.values["planner"]}
        return RecedingHorizonPlanner(
            # The recorded number of steps stands for the deadline.
            dataclasses.replace(planning, deadline=0.0),
            other.section(inputs, "planner", "impedance", ImpedanceSettings),
            other.budget(inputs, "planner").permitted_force,
            int(told["max_spheres"]),
        )

    def _start_of(self, number: int) -> int | None:
        """The plan to begin with so as to get to one; None if what it started from is not known."""
        while number in self.requests:
            if self.requests[number].afresh:
                return number
            before = self._solutions.get(number - 1)
            if number - 1 in self.requests and before is not None and distribution_of(before) is not None:
                return number
            number -= 1
        return None

    def _history(self, number: int) -> History:
        first = number
        while first - 1 in self._solutions and number - first < _IN_FORCE - 1 and not self.requests[first].afresh:
            first -= 1
        plans = tuple(self._plan(earlier) for earlier in range(first, number + 1))
        request, parts = self.requests[number], self._solutions[number]
        distribution = distribution_of(parts)
        if distribution is None:
            raise BagError(f"plan {number} has no distribution recorded")
        approach = Approach(*parts["approach"].tolist())
        memory = Memory(plans[-1], request.goal, parts["best"], distribution, approach)
        since_reset = int(self.statistics[number]["plans since reset"]) + 1
        return History(plans, memory, (request.state_ns, request.q), since_reset)

    def _plan(self, number: int) -> Plan:
        """A recorded plan, as far as later ones need it."""
        parts = self._solutions[number]
        positions = parts["positions"].reshape(-1, 3).astype(float)
        knots, nothing = len(positions), np.zeros(0)
        planning = self._inputs.section("planner", "planning", PlanningSettings)
        return Plan(
            number=number,
            effect_ns=self._effects[number],
            knot_duration_s=planning.knot_duration,
            positions=positions,
            rotations=parts["rotations"].reshape(knots, 3, 3).astype(float),
            postures=parts["postures"].reshape(knots, iiwa14.N_JOINTS).astype(float),
            predicted_q=nothing,
            predicted_positions=nothing,
            predicted_contact_forces=nothing,
            cost=float(self.statistics[number]["cost"]),
            cost_terms={},
            steps=int(self.statistics[number]["steps"]),
            stop_reason=self.statistics[number]["stop reason"],
            solve_s=0.0,
            rejected=0,
            left_out=0,
        )

    def _compare(self, plan: Plan, planner: RecedingHorizonPlanner, number: int) -> PlanDifference | None:
        """The first difference from the recorded plan."""
        statistics, parts = self.statistics[number], self._solutions.get(number)
        said: dict[str, Any] = {
            "steps": plan.steps,
            "non-finite candidates": plan.rejected,
            "spheres left out": plan.left_out,
            "cost": plan.cost,
            **{f"cost {name}": value for name, value in plan.cost_terms.items()},
        }
        for field, value in said.items():
            if statistics.get(field) != str(value):
                return PlanDifference(number, field, statistics.get(field, "nothing"), str(value))
        memory = planner.memory
        if parts is None or memory is None:
            return None
        found = {"positions": plan.positions, "rotations": plan.rotations, "postures": plan.postures}
        found |= {"best": memory.best, "approach": np.array(memory.approach)}
        for field in _SOLUTION:
            recorded, now = parts[field].ravel(), np.asarray(found[field], dtype=np.float32).ravel()
            if recorded.shape != now.shape:
                return PlanDifference(number, f"number of {field}", recorded.size, now.size)
            off = np.flatnonzero(recorded != now)
            if off.size:
                index = int(off[0])
                return PlanDifference(number, f"{field}[{index}]", float(recorded[index]), float(now[index]))
        return None

    def _follow_the_node(self) -> dict[int, Request]:
        """What the planner's node did with its messages, up to each plan."""
        inputs, model = self._inputs, RobotModel()
        told = inputs.settings["planner"]
        obstacles = _ObstacleReader(told)
        reaction = ContactReaction(
            inputs.section("planner", "unexpected_contact", UnexpectedContactSettings),
            inputs.section("planner", "planning", PlanningSettings).contact_stiffness,
            sees_spheres=True,
        )
        requests: dict[int, Request] = {}
        goal: Goal | None = None
        early: Any = None
        spheres = Spheres.none()
        state: tuple[Array, Array] | None = None
        afresh = not inputs.intakes["planner"].starts_late

        def take_goal(message: Any, q: Array) -> Goal | None:
            pose = message.pose
            try:
                return make_goal(
                    message.header.frame_id,
                    np.array([pose.position.x, pose.position.y, pose.position.z]),
                    np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w]),
                    told.get("goal_orientation", "hold"),
                    model.flange_pose(q)[1],
                )
            except InputError:
                return goal

        for row in inputs.intakes["planner"]:
            if row.what is Taken.ACTIVATE:
                goal, afresh = None, True
            elif row.what is Taken.OBSTACLES:
                spheres = obstacles.read(inputs, row.sent_ns, spheres)
            elif row.what is Taken.GOAL_POSE:
                message = inputs.message(row.what, row.sent_ns)
                if state is None:
                    early = message
                elif message is not None:
                    goal = take_goal(message, state[0])
            elif row.what is Taken.SAFETY_STATE:
                message = inputs.message(row.what, row.sent_ns)
                level = 0 if message is None else message.level
                if (level[0] if isinstance(level, bytes) else level) >= 2 and goal is not None:
                    goal, afresh = None, True
            elif row.what is Taken.JOINT_STATES:
                at = inputs.state_row(row.sent_ns)
                if at is None:
                    continue
                q, v = inputs.states.position[at], inputs.states.velocity[at]
                if not np.isfinite(q.sum() + v.sum()):
                    continue
                state = (q, v)
                if early is not None:
                    goal, early = take_goal(early, q), None
                if row.gave_output and goal is not None and row.output in self.statistics:
                    stamp_ns = int(inputs.states.stamp_ns[at])
                    reaction.recall(self.statistics[row.output])
                    asked = (reaction.goal(goal), reaction.spheres(spheres))
                    requests[row.output] = Request(q, v, stamp_ns, self._effects[row.output], *asked, afresh)
                    afresh = False
        return requests


class _ObstacleReader:
    """Obstacle messages as the node reads them, which takes ROS."""

    def __init__(self, told: Mapping[str, Any]) -> None:
        names = ("sphere_stiffness", "sphere_damping", "node_stiffness", "node_damping", "edge_stiffness")
        self._material = [float(told[name]) for name in names]
        self._reader: Any = None

    def read(self, inputs: RecordedInputs, sent_ns: int, before: Spheres) -> Spheres:
        """The spheres of a message; those before where it cannot be read."""
        raw = inputs.raw_message(Taken.OBSTACLES, sent_ns)
        if raw is None:
            return before
        if self._reader is None:
            try:
                from contact_reach_ros.nodes.obstacle_markers import Material, ObstacleMarkerReader
            except ImportError as error:
                raise BagError(f"making plans among obstacles again needs ROS 2: {error}") from error
            self._reader = ObstacleMarkerReader(Material(*self._material))
        try:
            return self._reader.read_serialized(raw.data)
        except InputError:
            return before


def _read_plans(
    inputs: RecordedInputs,
) -> tuple[dict[int, dict[str, str]], dict[int, int], dict[int, dict[str, NDArray[np.float32]]]]:
    """By plan: what is said of it, when it takes effect, and its solution."""
    bag = inputs.bag
    statistics: dict[int, dict[str, str]] = {}
    effects: dict[int, int] = {}
    solutions: dict[int, dict[str, NDArray[np.float32]]] = {}
    wanted = {inputs.topic("plan/statistics"), inputs.topic("plan/solution")}
    for message in bag.messages([topic for topic in wanted if topic in bag.topics()]):
        content = message.message
        if message.topic == inputs.topic("plan/solution"):
            parts = _parts(content)
            if parts:
                solutions[int(parts["plan"][0])] = parts
            continue
        for status in content.status:
            values = {entry.key: entry.value for entry in status.values}
            number = int(values.get("plan", "0"))
            statistics[number] = values
            effects[number] = content.header.stamp.sec * NANOSECONDS + content.header.stamp.nanosec
    return statistics, effects, solutions


def _parts(message: Any) -> dict[str, NDArray[np.float32]]:
    sizes: Sequence[int] = [dimension.size for dimension in message.layout.dim]
    data = np.asarray(message.data, dtype=np.float32)
    names = [dimension.label for dimension in message.layout.dim]
    if sum(sizes) != len(data) or "plan" not in names:
        return {}
    return dict(zip(names, np.split(data, np.cumsum(sizes)[:-1]), strict=True))
