"""A client of a simulated stack that follows the arm to a target."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.bringup.stack_processes import StackError, StackProcesses
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import JointStateReader
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.client import PLANNER, StackClient
from contact_reach_ros.ros.interfaces import RECORDER
from contact_reach_ros.timing import NANOSECONDS

_READY_S = 60.0
"""For nodes that are up to hear each other, and for the brakes to open."""
_NOT_READY = (topics.WAITING_FOR_STATE, topics.WAITING_FOR_OBSTACLES, topics.WAITING_FOR_CONTROLLER)
_RELIABLE = topics.NEWEST._replace(reliable=True)
"""For joint states: the last one before simulated time stands still must not get lost."""


class Follower(StackClient):
    """Hears where the flange is and what touches the arm, and waits until the stack is ready.

    Parameters
    ----------
    node
        No other executor may serve it.
    model
        Of the arm.
    target
        (3,) m in the base frame: what `distance` is measured to.
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

    def __init__(self, node: Node, model: RobotModel, target: Array, recorded: Sequence[Topic] = ()) -> None:
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
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        self.inbox.add(topics.JOINT_STATES, self._on_state, _RELIABLE, serialized=True)
        self.inbox.add(topics.SIM_CONTACTS, self._on_contacts, topics.NEWEST)

    def wait_to_start(self, stack: StackProcesses) -> None:
        """Wait until brakes are open, planner and recorder hear what they need, and the planner is heard.

        Raises `ContactReachError` if a process died, something stopped the arm, or it takes too long.
        """

        def missing() -> list[str]:
            stack.check()
            if self.stops:
                raise StackError(self.state)
            return self.missing()

        self.wait_for(missing, _READY_S)

    def missing(self) -> list[str]:
        """As `StackClient`, and what keeps the arm from being moved."""
        summary = self.summaries.get(PLANNER, "")
        heard = {
            topics.JOINT_STATES.name: self.stamp_ns > 0,
            f"{topics.COMMANDS.name} by the driver, whose brakes are closed": self._commanded,
            f"{topics.REFERENCE_POSE.name}, as the {PLANNER} is {summary}": summary not in _NOT_READY,
            **{f"{topic.name} by the {RECORDER}": self.hears(RECORDER, topic) for topic in self._recorded},
        }
        return super().missing() + [what for what, is_heard in heard.items() if not is_heard]

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

    def _on_state(self, data: bytes) -> None:
        self.stamp_ns, q, _, torque = self._reader.read(data)
        self.position, _ = self._model.tip_pose(q)
        self.distance = float(np.linalg.norm(self.position - self.target))
        # The driver knows no acting torque while its brakes are closed.
        self._commanded = torque is not None and bool(np.isfinite(torque).all())

    def _on_contacts(self, message: JointState) -> None:
        self.force = message.effort[-1] if message.effort else 0.0
