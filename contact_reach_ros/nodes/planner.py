"""The planner: goals in, paired references out, re-planned all the time.

The loop thread is the worker that solves; the executor in a thread of its own goes on serving services meanwhile.
"""

from __future__ import annotations

import array
import dataclasses
import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.hearing import commanders_that_hear
from contact_reach_ros.nodes.managed import ManagedNode, run
from contact_reach_ros.nodes.messages import (
    quaternion,
    set_time,
    to_duration,
    to_point,
    to_time,
    to_transform,
    vector,
)
from contact_reach_ros.nodes.observer import NAME as OBSERVER
from contact_reach_ros.nodes.observer import read_contact
from contact_reach_ros.nodes.obstacle_markers import Material, ObstacleMarkerReader
from contact_reach_ros.nodes.parameters import Sections
from contact_reach_ros.nodes.plan_markers import PlanMarkers
from contact_reach_ros.nodes.realtime import Role
from contact_reach_ros.nodes.serialized import JointStateReader
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.planning.goal import ORIENTATIONS, make_goal
from contact_reach_ros.planning.problem import Goal, Plan, Spheres
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.unexpected_contact import ContactReaction, UnexpectedContactSettings
from contact_reach_ros.plant.plant import TICK
from contact_reach_ros.recording.plan_record import solution_parts
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.timing import Histogram
from contact_reach_ros.units import NANOSECONDS

NAME = "planner"

_IDLE_NS = 100_000_000
_POLL_S = 0.003
_RECENT = 8
_MARKERS_EVERY_NS = 100_000_000
_MAX_LATENCY_NS = NANOSECONDS // 4
_TICK_NS = int(TICK * NANOSECONDS)


@dataclass(frozen=True)
class PlannerSettings(Settings):
    """When to plan, and for what."""

    period: float = setting(0.03, "least time between plans", unit="s", minimum=0.005, maximum=1.0)
    latency: float = setting(
        0.04,
        "least time from a state to the effect of its plan; in lockstep exactly that",
        unit="s",
        minimum=0.001,
        maximum=0.5,
    )
    goal_orientation: str = setting(
        "hold",
        "orientation of the goal: held as it is when the goal arrives, the pose's, or left free",
        choices=ORIENTATIONS,
    )
    contact_budget: str = setting("", "contact budget YAML; the one of the package when empty")
    max_spheres: int = setting(
        1, "obstacle spheres that a plan looks at, the nearest ones; 0 plans without contact", minimum=0, maximum=64
    )
    sphere_stiffness: float = setting(
        100.0, "spring that holds an obstacle sphere to its place", unit="N/m", minimum=1.0, maximum=5000.0
    )
    sphere_damping: float = setting(
        30.0, "damping of an obstacle sphere's motion", unit="N s/m", minimum=0.1, maximum=500.0
    )
    node_stiffness: float = setting(
        0.0, "spring that holds a movable node of a deformable body", unit="N/m", minimum=0.0, maximum=5000.0
    )
    node_damping: float = setting(5.0, "damping of a node's motion", unit="N s/m", minimum=0.1, maximum=500.0)
    edge_stiffness: float = setting(
        60.0, "spring between two nodes that an edge joins", unit="N/m", minimum=1.0, maximum=5000.0
    )


class PlannerNode(ManagedNode):
    """Plans from the newest state whenever there is a goal."""

    NAME = NAME
    SECTIONS: ClassVar[Sections] = {
        "": PlannerSettings,
        "unexpected_contact": UnexpectedContactSettings,
        "planning": PlanningSettings,
        "impedance": ImpedanceSettings,
    }

    def __init__(self) -> None:
        super().__init__()
        self._poses = self.make_publisher(topics.REFERENCE_POSE)
        self._postures = self.make_publisher(topics.REFERENCE_POSTURE)
        self._path = self.make_publisher(topics.PLAN_PATH)
        self._marker_publisher = self.make_publisher(topics.PLAN_MARKERS)
        self._statistics = self.make_publisher(topics.PLAN_STATISTICS)
        self._solutions = self.make_publisher(topics.PLAN_SOLUTION)
        self._intake = self.log_intake(topics.PLANNER_INTAKE)
        self._horizon = self.make_publisher(topics.LOCKSTEP_HORIZON) if self.lockstep else None
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self.inbox.add(topics.OBSTACLES, self._on_obstacles, serialized=True)
        self.inbox.add(topics.GOAL_POSE, self._on_goal)
        qos = topics.EVERY if self.lockstep else topics.NEWEST
        self.inbox.add(topics.JOINT_STATES, self._on_state, qos, serialized=True)
        settings = self.settings[""]
        self._period_ns = int(settings.period * NANOSECONDS)
        self._min_latency_ns = int(settings.latency * NANOSECONDS)
        self._recent_ns: deque[int] = deque(maxlen=_RECENT)
        self._reader = JointStateReader(iiwa14.JOINT_NAMES, topics.JOINT_STATES.name)
        self._model = RobotModel()
        self._planner: RecedingHorizonPlanner | None = None
        self._budget = ContactBudget()
        self._goal: Goal | None = None
        self._early_goal: PoseStamped | None = None
        self._spheres = Spheres.none()
        self._obstacle_reader = ObstacleMarkerReader(
            Material(
                settings.sphere_stiffness,
                settings.sphere_damping,
                settings.node_stiffness,
                settings.node_damping,
                settings.edge_stiffness,
            )
        )
        self._reaction = ContactReaction(
            self.settings["unexpected_contact"], self.settings["planning"].contact_stiffness, settings.max_spheres > 0
        )
        self._state: tuple[np.ndarray, np.ndarray] | None = None
        self._state_ns = 0
        self._due_ns = 0
        self._promised_ns = 0
        self._plan: Plan | None = None
        self._markers: PlanMarkers | None = None
        self._markers_due_ns = 0
        self._goals = 0
        self._late = 0
        self._solve_times = Histogram(bucket_us=100)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Compile the solver."""
        settings = self.settings[""]
        try:
            self._budget = budget = load_budget(settings.contact_budget)
            planning = self.settings["planning"]
            if self.lockstep:
                # A deadline on the wall clock would let the result depend on how busy the machine is.
                planning = dataclasses.replace(planning, deadline=0.0)
            self._markers = PlanMarkers(budget.permitted_force)
            self._planner = RecedingHorizonPlanner(
                planning, self.settings["impedance"], budget.permitted_force, settings.max_spheres
            )
            began = time.monotonic()
            self._planner.warm_up(lambda line: self.get_logger().info(line))
        except ContactReachError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self.get_logger().info(f"compiled in {time.monotonic() - began:.1f} s")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Wait for a goal."""
        self._withdraw()
        return super().on_activate(state)

    def files(self) -> Mapping[str, Settings]:
        """The contact budget."""
        return {"budget": self._budget}

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Plans, solve times and the parts of the last plan's cost."""
        values: dict[str, Any] = {
            "goals": self._goals,
            "late plans": self._late,
            **{f"solve {key} us": value for key, value in self._solve_times.summary().items()},
            "solve max us": self._solve_times.maximum_ns / 1000,
        }
        heard_by = commanders_that_hear(self, (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE))
        values["heard by"] = ", ".join(heard_by)
        plan = self._plan
        if plan is not None:
            values |= {
                "plan": plan.number,
                "plan age s": (self.get_clock().now().nanoseconds - plan.effect_ns) / NANOSECONDS,
                "solve ms": 1000 * plan.solve_s,
                "steps": plan.steps,
                "stop reason": plan.stop_reason,
                "cost": plan.cost,
                "non-finite candidates": plan.rejected,
                "spheres left out": plan.left_out,
                **{f"cost {name}": value for name, value in plan.cost_terms.items()},
            }
            if self._planner is not None and self._planner.memory is not None:
                values["contact share"] = self._planner.memory.approach.share
        if self._state is None:
            return topics.WAITING_FOR_STATE, values
        if self._reaction.reason:
            return f"{self._reaction.reaction}: {self._reaction.reason}", values
        if self._goal is not None:
            return "planning", values
        return "waiting for a goal" if heard_by else topics.WAITING_FOR_CONTROLLER, values

    def turn(self) -> None:
        """Handle what arrived; `_on_state` plans when a plan is due."""
        if not self.lockstep:
            # States come much faster than plans are made; looking at each would only take time from the loops.
            self._stop.wait(_POLL_S)
        self.inbox.wait(_IDLE_NS)

    def _on_state(self, data: bytes) -> None:
        try:
            now_ns, q, v, _ = self._reader.read(data)
            if not np.isfinite(q.sum() + v.sum()):
                raise InputError(f"joint_states: position and velocity must be finite, got {q.tolist()}, {v.tolist()}")
        except InputError as error:
            self.refuse("joint states", error)
            return
        self._state, self._state_ns = (q, v), now_ns
        if self._early_goal is not None:
            early, self._early_goal = self._early_goal, None
            self._on_goal(early)
        if self._goal is not None and now_ns >= self._due_ns:
            flange, _ = self._model.flange_pose(q)
            self._reaction.moved(flange)
            effect_ns = now_ns + self._latency_ns()
            self._promise(effect_ns - _TICK_NS)
            try:
                self._make_plan(q, v, now_ns, effect_ns, self._goal)
            except InputError as error:
                self.refuse("plans", error)
            self._due_ns = now_ns + self._period_ns
        # Nothing can take effect before the next plan that may still be asked for.
        self._promise(max(now_ns + _TICK_NS, self._due_ns) + self._min_latency_ns - _TICK_NS)

    def _latency_ns(self) -> int:
        """Time until a plan begun now can take effect: what the last ones took, on a machine that may be busy."""
        if self.lockstep or not self._recent_ns:
            return self._min_latency_ns
        return max(self._min_latency_ns, min(max(self._recent_ns), _MAX_LATENCY_NS))

    def _make_plan(self, q: np.ndarray, v: np.ndarray, now_ns: int, effect_ns: int, goal: Goal) -> None:
        if self._planner is None:
            return
        began_ns = time.monotonic_ns()
        goal, spheres = self._reaction.goal(goal), self._reaction.spheres(self._spheres)
        plan = self._planner.plan(q, v, now_ns, effect_ns, goal, spheres)
        self._publish(plan)
        self._intake.outputs += 1
        took_ns = time.monotonic_ns() - began_ns
        self._solve_times.add(took_ns)
        self._recent_ns.append(took_ns)
        self._late += took_ns > effect_ns - now_ns
        self._plan = plan
        self._show(plan)
        self._tell(plan, now_ns, took_ns)

    def _tell(self, plan: Plan, state_ns: int, took_ns: int) -> None:
        """For bags: how the plan was found, and what it takes to find it again."""
        planner = self._planner
        if planner is None or planner.memory is None:
            return
        values = {
            "plan": plan.number,
            "state ns": state_ns,
            # The planner has counted this plan already.
            "plans since reset": planner.since_reset - 1,
            "steps": plan.steps,
            "stop reason": plan.stop_reason,
            "solve ms": 1000 * plan.solve_s,
            "took ms": took_ns / 1e6,
            "non-finite candidates": plan.rejected,
            "spheres left out": plan.left_out,
            "cost": plan.cost,
            **{f"cost {name}": value for name, value in plan.cost_terms.items()},
            **self._reaction.told(),
        }
        status = DiagnosticStatus(name=NAME, message=plan.stop_reason)
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        header = Header(stamp=to_time(plan.effect_ns), frame_id=iiwa14.BASE_NAME)
        self._statistics.publish(DiagnosticArray(header=header, status=[status]))
        parts = solution_parts(plan, planner.memory)
        message = Float32MultiArray()
        message.layout.dim = [MultiArrayDimension(label=name, size=part.size) for name, part in parts.items()]
        message.data = array.array("f", np.concatenate([part.ravel() for part in parts.values()]).tobytes())
        self._solutions.publish(message)

    def _show(self, plan: Plan) -> None:
        if self._markers is not None and plan.effect_ns >= self._markers_due_ns:
            self._marker_publisher.publish(self._markers.show(plan))
            self._markers_due_ns = plan.effect_ns + _MARKERS_EVERY_NS

    def _promise(self, until_ns: int) -> None:
        """In lockstep: no plan that takes effect up to then is still to come."""
        if self._horizon is not None and until_ns > self._promised_ns:
            self._promised_ns = until_ns
            header = Header(frame_id=NAME)
            set_time(header.stamp, until_ns)
            self._horizon.publish(header)

    def _publish(self, plan: Plan) -> None:
        header = Header(stamp=to_time(plan.effect_ns), frame_id=iiwa14.BASE_NAME)
        knot_ns = int(plan.knot_duration_s * NANOSECONDS)
        times = [to_duration((index + 1) * knot_ns) for index in range(len(plan.positions))]
        poses = MultiDOFJointTrajectory(header=header, joint_names=[iiwa14.FLANGE_NAME])
        postures = JointTrajectory(header=header, joint_names=list(iiwa14.JOINT_NAMES))
        for time_from_start, position, rotation, posture in zip(
            times, plan.positions, plan.rotations, plan.postures, strict=True
        ):
            transform = to_transform(position, rotation)
            poses.points.append(MultiDOFJointTrajectoryPoint(transforms=[transform], time_from_start=time_from_start))
            point = JointTrajectoryPoint(positions=posture.tolist(), time_from_start=time_from_start)
            postures.points.append(point)
        self._poses.publish(poses)
        self._postures.publish(postures)
        path = Path(header=header)
        for index, position in enumerate(plan.predicted_positions.tolist()):
            stamp = to_time(plan.effect_ns + index * knot_ns)
            pose = PoseStamped(header=Header(stamp=stamp, frame_id=iiwa14.BASE_NAME))
            pose.pose.position = to_point(position)
            path.poses.append(pose)
        self._path.publish(path)

    def _on_goal(self, message: PoseStamped) -> None:
        if self._state is None:
            # It is checked, and counts, as soon as the pose of the arm is known.
            self._early_goal = message
            self.get_logger().info("goal_pose: waiting for the first joint state")
            return
        try:
            _, rotation = self._model.flange_pose(self._state[0])
            pose = message.pose
            goal = make_goal(
                message.header.frame_id,
                vector(pose.position),
                quaternion(pose.orientation),
                self.settings[""].goal_orientation,
                rotation,
            )
        except InputError as error:
            self.refuse("goals", error)
            return
        self._goal = goal
        self._reaction.reset()
        self._goals += 1
        self.get_logger().info(f"goal {self._goals}: {np.round(goal.position, 3).tolist()} m")

    def _on_obstacles(self, data: bytes) -> None:
        try:
            self._spheres = self._obstacle_reader.read_serialized(data)
        except InputError as error:
            self.refuse("obstacles", error)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        if message.level >= DiagnosticStatus.ERROR and self._goal is not None:
            self.get_logger().warning(f"goal withdrawn: {message.name} stopped the arm ({message.message})")
            self._withdraw()
        elif message.name == OBSERVER and self._goal is not None and self._state is not None:
            self._on_contact(message, self._state[0])

    def _on_contact(self, message: DiagnosticStatus, q: np.ndarray) -> None:
        """What the observer tells of contact within the budget, or that there is none."""
        try:
            contact = read_contact(message)
        except InputError as error:
            self.refuse("contacts", error)
            return
        known = self._reaction.reason
        if self._reaction.report(contact, q, self._spheres, self._state_ns):
            self._due_ns = self._state_ns
            if not known:
                self.get_logger().warning(f"{self._reaction.reaction}: {self._reaction.reason}")

    def _withdraw(self) -> None:
        """Forget the goal: after a stop the arm moves again only when somebody sends a new one."""
        if self._markers is not None and self._plan is not None:
            self._marker_publisher.publish(self._markers.clear())
        self._goal = None
        self._plan = None
        self._reaction.reset()
        if self._planner is not None:
            self._planner.reset()


def main() -> None:
    """Run the planner."""
    sys.exit(run(PlannerNode, Role.COMPUTING, sys.argv))


if __name__ == "__main__":
    main()
