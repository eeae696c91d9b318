"""What a user's node sees of the running stack."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import MultiDOFJointTrajectory

from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.messages import JointOrder, nanoseconds
from contact_reach_ros.nodes.supervisor import Supervisor
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.units import NANOSECONDS

_PLANNER = "planner"


class Watcher:
    """Newest state of the stack, as a user's node would see it."""

    def __init__(self, supervisor: Supervisor, model: RobotModel, target: np.ndarray) -> None:
        self._model = model
        self._target = target
        self._order = JointOrder(iiwa14.JOINT_NAMES)
        self.stamp_ns = 0
        self.distance = float("nan")
        self.force = 0.0
        self.safety = "starting"
        self.stopped = False
        self.commanded = False
        self.plan_ns = 0
        self.planner_ready = False
        inbox = supervisor.inbox
        inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST)
        inbox.add(topics.SIM_CONTACTS, self._on_contacts, topics.NEWEST)
        inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        inbox.add(topics.REFERENCE_POSE, self._on_plan, topics.NEWEST)
        inbox.add(topics.DIAGNOSTICS, self._on_diagnostics)

    def line(self, since_ns: int) -> str:
        """One line of progress."""
        age = f"{(self.stamp_ns - self.plan_ns) / 1e6:4.0f} ms" if self.plan_ns else "   -   "
        return (
            f"{(self.stamp_ns - since_ns) / NANOSECONDS:5.1f} s   distance {1000 * self.distance:6.1f} mm   "
            f"contact {self.force:5.1f} N   plan age {age}   {self.safety}"
        )

    def _on_state(self, message: JointState) -> None:
        position, _ = self._model.flange_pose(self._order.pick(message, "position", topics.JOINT_STATES.name))
        self.distance = float(np.linalg.norm(position - self._target))
        self.stamp_ns = nanoseconds(message.header.stamp)
        # The driver knows no acting torque while its brakes are closed.
        self.commanded = bool(np.isfinite(message.effort).all())

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
            if status.name == _PLANNER:
                self.planner_ready = status.message != topics.WAITING_FOR_STATE

    def _on_plan(self, message: MultiDOFJointTrajectory) -> None:
        self.plan_ns = nanoseconds(message.header.stamp)
