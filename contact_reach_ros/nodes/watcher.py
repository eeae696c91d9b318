"""What a user's node sees of the running stack."""

from __future__ import annotations

import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import MultiDOFJointTrajectory

from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.messages import nanoseconds, to_point
from contact_reach_ros.nodes.supervisor import StackError, Supervisor
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.joint_order import JointOrder
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.units import NANOSECONDS

DISCOVERY_S = 15.0
"""For nodes that are up to hear each other."""

_PLANNER = "planner"
_LOOK_S = 0.1


class Watcher:
    """Newest state of the stack, as a user's node would see it, and a publisher of goals.

    Parameters
    ----------
    node
        That publishes goals, and looks by way of the supervisor's inbox.
    supervisor
        Of the stack.
    model
        For the flange's position.
    target
        (3,) m in the base frame: what `distance` is measured to, and `send_goal` sends.

    Attributes
    ----------
    stamp_ns
        Of the newest joint state.
    position
        (3,) m of the flange, base frame.
    distance
        To `target`, m.
    force
        On the most loaded body, N.
    safety
        What the controller does, or the first stop.
    stopped
        Whether anything has stopped the arm.
    diagnostics
        Newest values by name, of each node.
    """

    def __init__(self, node: Node, supervisor: Supervisor, model: RobotModel, target: np.ndarray) -> None:
        self._node = node
        self._supervisor = supervisor
        self._goals = node.create_publisher(topics.GOAL_POSE.type, topics.GOAL_POSE.name, topics.GOAL_POSE.qos)
        self._model = model
        self.target = target
        self._order = JointOrder(iiwa14.JOINT_NAMES)
        self.stamp_ns = 0
        self.position = np.full(3, np.nan)
        self.distance = float("nan")
        self.force = 0.0
        self.safety = "starting"
        self.stopped = False
        self.plan_ns = 0
        self.diagnostics: dict[str, dict[str, str]] = {}
        self._commanded = False
        self._planner_ready = False
        inbox = supervisor.inbox
        inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST)
        inbox.add(topics.SIM_CONTACTS, self._on_contacts, topics.NEWEST)
        inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        inbox.add(topics.REFERENCE_POSE, self._on_plan, topics.NEWEST)
        inbox.add(topics.DIAGNOSTICS, self._on_diagnostics)

    def wait_ready(self, listeners: int) -> None:
        """Wait until brakes are open, the planner knows where the arm is and is heard, and so many nodes hear goals.

        Raises
        ------
        StackError
            If a process died, something stopped the arm, or it takes too long.
        """
        deadline = time.monotonic() + DISCOVERY_S
        while self._goals.get_subscription_count() < listeners or not (self._commanded and self._planner_ready):
            self._supervisor.spin(_LOOK_S)
            self._supervisor.check()
            if self.stopped:
                raise StackError(self.safety)
            if time.monotonic() > deadline:
                raise StackError(
                    f"after {DISCOVERY_S:.0f} s the driver does not hear the controller, the planner not the driver, "
                    "the controller not the planner, or nobody the goal"
                )

    def send_goal(self) -> None:
        """Ask the planner for `target`."""
        goal = PoseStamped()
        goal.header.frame_id = iiwa14.BASE_NAME
        goal.header.stamp = self._node.get_clock().now().to_msg()
        goal.pose.position = to_point(self.target.tolist())
        goal.pose.orientation.w = 1.0
        self._goals.publish(goal)

    def line(self, since_ns: int) -> str:
        """One line of progress."""
        age = f"{(self.stamp_ns - self.plan_ns) / 1e6:4.0f} ms" if self.plan_ns else "   -   "
        return (
            f"{(self.stamp_ns - since_ns) / NANOSECONDS:5.1f} s   distance {1000 * self.distance:6.1f} mm   "
            f"contact {self.force:5.1f} N   plan age {age}   {self.safety}"
        )

    def _on_state(self, message: JointState) -> None:
        self.position, _ = self._model.flange_pose(self._order.pick(message, "position", topics.JOINT_STATES.name))
        self.distance = float(np.linalg.norm(self.position - self.target))
        self.stamp_ns = nanoseconds(message.header.stamp)
        # The driver knows no acting torque while its brakes are closed.
        self._commanded = bool(np.isfinite(message.effort).all())

    def _on_contacts(self, message: JointState) -> None:
        self.force = message.effort[-1]

    def _on_safety(self, message: DiagnosticStatus) -> None:
        if message.level >= DiagnosticStatus.ERROR:
            self.stopped = True
            self.safety = f"STOP by {message.name}: {message.message}"
        elif message.name == "controller" and not self.stopped:
            self.safety = message.message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = {entry.key: entry.value for entry in status.values}
            if status.name == _PLANNER:
                self._planner_ready = status.message not in (topics.WAITING_FOR_STATE, topics.WAITING_FOR_CONTROLLER)

    def _on_plan(self, message: MultiDOFJointTrajectory) -> None:
        self.plan_ns = nanoseconds(message.header.stamp)
