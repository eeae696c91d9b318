"""The running stack as a user's node sees it."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import MultiDOFJointTrajectory

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.bringup.children import StackError
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose, to_time
from contact_reach_ros.messages.joint_order import JointOrder
from contact_reach_ros.messages.safety_state import is_stopped
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.ros.interfaces import DEMO
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.units import NANOSECONDS

DISCOVERY_S = 15.0
"""For nodes that are up to hear each other."""

_PLANNER = "planner"
_NOT_READY = (topics.WAITING_FOR_STATE, topics.WAITING_FOR_OBSTACLES, topics.WAITING_FOR_CONTROLLER)
_LOOK_S = 0.1
_PLANS = 50
"""That are remembered: those of the last second at least, of which the newest have not taken effect."""
_STEP_NS = 100_000_000
"""In lockstep, time from one look at whether the stack is ready to the next."""
_MAXIMUM_STEPS = 100


class Watcher:
    """Newest state of the stack, as a user's node would see it, and a publisher of goals.

    Parameters
    ----------
    node
        That publishes goals.
    stack
        Whose inbox is looked into.
    model
        Of the arm.
    target
        (3,) m in the base frame: what `distance` is measured to, and `send_goal` sends.
    lockstep_tick_ns
        In lockstep, time from one joint state to the next, ns: time then stands still whenever this looks whether the
        stack is ready, and when the goal is sent, so that it is sent at the same joint state each time. 0 in real time.

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

    def __init__(
        self, node: Node, stack: StackProcesses, model: RobotModel, target: np.ndarray, lockstep_tick_ns: int = 0
    ) -> None:
        self._node = node
        self._stack = stack
        self._goals = node.create_publisher(
            topics.GOAL_POSE.type, topics.GOAL_POSE.name, qos_profile(topics.GOAL_POSE.qos)
        )
        self._model = model
        self.target = target
        self._order = JointOrder(model.arm.joint_names)
        self.stamp_ns = 0
        self.position = np.full(3, np.nan)
        self.distance = float("nan")
        self.force = 0.0
        self.safety = "starting"
        self.stopped = False
        self._effects_ns: deque[int] = deque(maxlen=_PLANS)
        self.diagnostics: dict[str, dict[str, str]] = {}
        self._commanded = False
        self._planner_ready = False
        self._tick_ns, self._promised_ns, self._steps = lockstep_tick_ns, 0, 0
        self._lockstep = self._take_part() if lockstep_tick_ns else None
        inbox = stack.inbox
        # In lockstep, the last one before time stands still must not get lost.
        inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST._replace(reliable=lockstep_tick_ns > 0))
        inbox.add(topics.SIM_CONTACTS, self._on_contacts, topics.NEWEST)
        inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        inbox.add(topics.REFERENCE_POSE, self._on_plan, topics.Qos(_PLANS))
        inbox.add(topics.DIAGNOSTICS, self._on_diagnostics)

    def wait_ready(self, listeners: int) -> None:
        """Wait until brakes are open, the planner knows arm and obstacles and is heard, and so many nodes hear goals.

        Raises `StackError` if a process died, something stopped the arm, or it takes too long.
        """
        deadline = time.monotonic() + DISCOVERY_S
        while not (self._stands_still() and self._is_ready(listeners)):
            if self._go_on():
                deadline = time.monotonic() + DISCOVERY_S
            self._stack.spin(_LOOK_S)
            self._stack.check()
            if self.stopped:
                raise StackError(self.safety)
            if time.monotonic() > deadline:
                raise StackError(
                    f"after {DISCOVERY_S:.0f} s the driver does not hear the controller, the planner not the driver, "
                    "the controller not the planner, or nobody the goal"
                )

    def send_goal(self) -> None:
        """Ask the planner for `target`."""
        stamp = self._node.get_clock().now().to_msg() if self._lockstep is None else to_time(self.stamp_ns)
        self._goals.publish(to_goal_pose(self.target.tolist(), self._model.arm.base_frame, stamp))
        if self._lockstep is not None:
            self._lockstep.promise(FOREVER_NS)

    def line(self, since_ns: int) -> str:
        """One line of progress; the age of a plan is the time since it took effect."""
        effects = [effect_ns for effect_ns in self._effects_ns if effect_ns <= self.stamp_ns]
        age = f"{(self.stamp_ns - max(effects)) / 1e6:4.0f} ms" if effects else "   -   "
        return (
            f"{(self.stamp_ns - since_ns) / NANOSECONDS:5.1f} s   distance {1000 * self.distance:6.1f} mm   "
            f"contact {self.force:5.1f} N   plan age {age}   {self.safety}"
        )

    def _is_ready(self, listeners: int) -> bool:
        return self._goals.get_subscription_count() >= listeners and self._commanded and self._planner_ready

    def _take_part(self) -> Lockstep:
        """Take part in lockstep: time goes on as far as this promises."""
        topic = topics.LOCKSTEP_HORIZON
        publisher = self._node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
        lockstep = Lockstep(DEMO, self._tick_ns, publisher.publish)
        self._stack.inbox.add(topic, lockstep.hear, topics.EVERY)
        return lockstep

    def _stands_still(self) -> bool:
        """Whether time waits for this node, and everybody is done with the last joint state; always in real time."""
        if self._lockstep is None:
            return True
        return self.stamp_ns + self._tick_ns > self._promised_ns and self._lockstep.may_handle(self.stamp_ns)

    def _go_on(self) -> bool:
        """In lockstep, let time go on until the brakes are open; then it stands still while others get ready.

        Returns whether another step was permitted, of as many as should be enough.
        """
        if self._lockstep is None:
            return False
        steps = self._steps
        if steps < _MAXIMUM_STEPS and self._stands_still() and not self._commanded:
            self._steps += 1
            self._promised_ns = self.stamp_ns + _STEP_NS
        if self._promised_ns:
            # Each time: the driver may not have heard the first ones.
            self._lockstep.promise(self._promised_ns)
        return self._steps > steps

    def _on_state(self, message: JointState) -> None:
        self.position, _ = self._model.tip_pose(self._order.pick(message, "position", topics.JOINT_STATES.name))
        self.distance = float(np.linalg.norm(self.position - self.target))
        self.stamp_ns = nanoseconds(message.header.stamp)
        # The driver knows no acting torque while its brakes are closed.
        self._commanded = bool(np.isfinite(message.effort).all())

    def _on_contacts(self, message: JointState) -> None:
        self.force = message.effort[-1] if message.effort else 0.0

    def _on_safety(self, message: DiagnosticStatus) -> None:
        if is_stopped(message):
            self.stopped = True
            self.safety = f"STOP by {message.name}: {message.message}"
        elif message.name == "controller" and not self.stopped:
            self.safety = message.message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = {entry.key: entry.value for entry in status.values}
            if status.name == _PLANNER:
                self._planner_ready = status.message not in _NOT_READY

    def _on_plan(self, message: MultiDOFJointTrajectory) -> None:
        self._effects_ns.append(nanoseconds(message.header.stamp))
