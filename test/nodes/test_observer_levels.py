"""What the observer node publishes in safety_state, from joint states to messages."""

from collections.abc import Iterator

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS
from diagnostic_msgs.msg import DiagnosticStatus
from stack_helpers import Published, hand_in, ros

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.safety_state import read_contact
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.nodes.observer import ObserverNode

LIGHT = np.array([0.0, 5.0, 0.0, 4.0, 0.0, 0.0, 0.0])
UNKNOWN = np.full(7, np.nan)


class Watched:
    """An observer node that is given joint states of an arm at rest at home."""

    def __init__(self) -> None:
        self.node = ObserverNode()
        self.safety = self.node._safety = Published()
        self._writer = JointStateWriter(ARM.joint_names, ARM.base_frame, ["position", "velocity", "effort"])
        self._gravity = RobotModel(ARM).gravity_at(HOME)
        self._tick = 0

    def give(self, external: np.ndarray, count: int) -> None:
        for _ in range(count):
            self._tick += 1
            # As encoders tell an arm at rest; without any tremor they would be stuck.
            q = HOME + 1e-5 * (self._tick % 2)
            data = self._writer.write(self._tick * TICK_NS, q, REST, self._gravity - external)
            hand_in(self.node.inbox, topics.JOINT_STATES, data)

    @property
    def last(self) -> tuple[bytes, str, dict[str, str]]:
        message = self.safety.messages[-1]
        return message.level, message.message, {entry.key: entry.value for entry in message.values}


@pytest.fixture
def watched() -> Iterator[Watched]:
    with ros():
        watched = Watched()
        watched.give(UNKNOWN, 5)
        watched.give(REST, 400)
        yield watched


def test_levels_are_told_when_they_change_and_as_a_sign_of_life(watched):
    assert watched.last[:2] == (DiagnosticStatus.OK, "monitoring")
    before = len(watched.safety.messages)
    watched.give(REST, 100)
    assert len(watched.safety.messages) == before + 10
    watched.give(LIGHT, 60)
    level, message, values = watched.last
    assert (level, message, values["level"]) == (DiagnosticStatus.WARN, "contact", "contact")
    contact = read_contact(watched.safety.messages[-1], ARM)
    assert contact.link == values["contact link"] and contact.link in ARM.link_names[1:]
    assert contact.strength == pytest.approx(float(values["contact force N"]), abs=0.2) and contact.strength > 5.0
    # On the axis of a link near home's flange, and not at the base.
    assert 0.2 < np.linalg.norm(contact.position - [0.0, 0.0, 0.36]) < 0.9
    # The message has no numbers, so that a bag's reader sees one change.
    assert {entry.message for entry in watched.safety.messages} == {"monitoring", "contact"}
    watched.give(REST, 400)
    assert watched.last[:2] == (DiagnosticStatus.OK, "monitoring") and "contact link" not in watched.last[2]


def test_stop_is_an_error_with_its_reason_and_is_latched(watched):
    watched.give(3.0 * LIGHT, 60)
    level, message, values = watched.last
    assert level == DiagnosticStatus.ERROR and message.startswith("sudden external torque on lbr_A")
    assert values["level"] == "collision" and float(values["contact force N"]) > 20.0
    watched.give(REST, 400)
    assert watched.last[:2] == (level, message)
