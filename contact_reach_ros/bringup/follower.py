"""A client of a simulated stack that follows the arm to a target."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.bringup.children import StackError
from contact_reach_ros.bringup.stack_processes import StackProcesses
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.messages.values import nanoseconds, pick
from contact_reach_ros.ros.client import PLANNER, StackClient
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import RECORDER
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep
from contact_reach_ros.timing import NANOSECONDS

_DISCOVERY_S = 30.0
"""For nodes that are up to hear each other."""
_BRAKES_OPEN_S = 60.0
"""In lockstep, for that and until the brakes are open."""
_NOT_READY = (topics.WAITING_FOR_STATE, topics.WAITING_FOR_OBSTACLES, topics.WAITING_FOR_CONTROLLER)
_LOOK_S = 0.1
_STEP_NS = 100_000_000
"""In lockstep, time from one look at whether the stack is ready to the next."""


class Follower(StackClient):
    """Hears where the flange is and what touches the arm, and sends its target when the stack is ready.

    Parameters
    ----------
    node
        No other executor may serve it.
    model
        Of the arm.
    target
        (3,) m in the base frame: what `distance` is measured to, and `send_target` sends.
    lockstep_tick_ns
        In lockstep, time from one joint state to the next, ns: time then stands still whenever this looks whether the
        stack is ready, and when the goal is sent, so that it is sent at the same joint state each time. 0 in real time.
    recorded
        What the recorder must hear before the arm moves.

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
    """

    def __init__(
        self, node: Node, model: RobotModel, target: Array, lockstep_tick_ns: int = 0, recorded: Sequence[Topic] = ()
    ) -> None:
        super().__init__(node)
        self.arm = model.arm
        self._model = model
        self.target = target
        self._recorded = recorded
        self.stamp_ns = 0
        self.position = np.full(3, np.nan)
        self.distance = float("nan")
        self.force = 0.0
        self._commanded = False
        self._tick_ns, self._promised_ns = lockstep_tick_ns, 0
        self._lockstep: Lockstep | None = None
        if lockstep_tick_ns:
            topic = topics.LOCKSTEP_HORIZON
            publisher = node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
            self._lockstep = Lockstep(node.get_name(), lockstep_tick_ns, publisher.publish)
            self.inbox.add(topic, self._lockstep.hear, topics.STREAM)
        # In lockstep, the last one before time stands still must not get lost.
        self.inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST._replace(reliable=lockstep_tick_ns > 0))
        self.inbox.add(topics.SIM_CONTACTS, self._on_contacts, topics.NEWEST)

    def wait_to_start(self, stack: StackProcesses) -> None:
        """Wait until brakes are open, planner and recorder hear what they need, and the planner is heard.

        Raises `StackError` if a process died, something stopped the arm, or it takes too long.
        """
        patience = _DISCOVERY_S if self._lockstep is None else _BRAKES_OPEN_S
        deadline = time.monotonic() + patience
        while missing := self.missing():
            if self._lockstep is not None:
                # Time goes on until the brakes are open, and then stands still while others get ready.
                if self._stands_still() and not self._commanded:
                    self._promised_ns = self.stamp_ns + _STEP_NS
                # Each time: the driver may not have heard the first ones.
                if self._promised_ns:
                    self._lockstep.promise(self._promised_ns)
            stack.watch(_LOOK_S)
            if self.stops:
                raise StackError(self.state)
            if time.monotonic() > deadline:
                raise StackError(f"not heard after {patience:.0f} s: {', '.join(missing)}")

    def missing(self) -> list[str]:
        """As `StackClient`, and what keeps the arm from being moved."""
        summary = self.summaries.get(PLANNER, "")
        heard = {
            topics.JOINT_STATES.name: self.stamp_ns > 0,
            f"{topics.COMMANDS.name} by the driver, whose brakes are closed": self._commanded,
            f"{topics.REFERENCE_POSE.name}, as the {PLANNER} is {summary}": summary not in _NOT_READY,
            **{f"{topic.name} by the {RECORDER}": self.hears(RECORDER, topic) for topic in self._recorded},
            f"{topics.LOCKSTEP_HORIZON.name} up to the last joint state": self._stands_still(),
        }
        return super().missing() + [what for what, is_heard in heard.items() if not is_heard]

    def send_target(self) -> None:
        """Make `target` the goal; in lockstep time then goes on."""
        self.send_goal(self.target, stamp_ns=None if self._lockstep is None else self.stamp_ns)
        if self._lockstep is not None:
            self._lockstep.promise(FOREVER_NS)

    @property
    def state(self) -> str:
        """What stopped the arm, or what the controller does."""
        return f"STOP by {self.why_stopped}" if self.stops else self.safety

    def line(self, since_ns: int) -> str:
        """One line of progress."""
        return (
            f"{(self.stamp_ns - since_ns) / NANOSECONDS:5.1f} s   distance {1000 * self.distance:6.1f} mm   "
            f"contact {self.force:5.1f} N   {self.state}"
        )

    def _stands_still(self) -> bool:
        """Whether time waits for this node, and everybody is done with the last joint state; always in real time."""
        if self._lockstep is None:
            return True
        return self.stamp_ns + self._tick_ns > self._promised_ns and self._lockstep.may_handle(self.stamp_ns)

    def _on_state(self, message: JointState) -> None:
        joints = self._model.arm.joint_names
        self.position, _ = self._model.tip_pose(pick(message, joints, "position", topics.JOINT_STATES.name))
        self.distance = float(np.linalg.norm(self.position - self.target))
        self.stamp_ns = nanoseconds(message.header.stamp)
        # The driver knows no acting torque while its brakes are closed.
        self._commanded = bool(np.isfinite(message.effort).all())

    def _on_contacts(self, message: JointState) -> None:
        self.force = message.effort[-1] if message.effort else 0.0
