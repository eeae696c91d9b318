"""What the observer node publishes in safety_state, from joint states to messages."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from diagnostic_msgs.msg import DiagnosticStatus
from stack_helpers import AtRest, Published, ros

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.messages.safety_state import read_contact
from contact_reach_ros.nodes.observer import ObserverNode

LIGHT = np.array([0.0, 5.0, 0.0, 4.0, 0.0, 0.0, 0.0])
GRAVITY = RobotModel(ARM).gravity_at(HOME)


class Watched(AtRest):
    """An observer node that is told of external torques on an arm at rest."""

    def __init__(self):
        node = ObserverNode()
        super().__init__(node)
        self.safety = node._safety = Published()

    def push(self, external, count):
        self.give(count, GRAVITY - external)

    @property
    def last(self):
        message = self.safety.messages[-1]
        return message.level, message.message, {entry.key: entry.value for entry in message.values}


@pytest.fixture
def watched():
    with ros():
        watched = Watched()
        watched.push(np.full(7, np.nan), 5)
        watched.push(REST, 400)
        yield watched


def test_levels_are_told_when_they_change_and_as_a_sign_of_life(watched):
    assert watched.last[:2] == (DiagnosticStatus.OK, "monitoring")
    before = len(watched.safety.messages)
    watched.push(REST, 100)
    assert len(watched.safety.messages) == before + 10
    watched.push(LIGHT, 60)
    level, message, values = watched.last
    assert (level, message, values["level"]) == (DiagnosticStatus.WARN, "contact", "contact")
    contact = read_contact(watched.safety.messages[-1], ARM)
    assert contact.link == values["contact link"] and contact.link in ARM.link_names[1:]
    assert contact.strength == pytest.approx(float(values["contact force N"]), abs=0.2) and contact.strength > 5.0
    # On the axis of a link near home's flange, and not at the base.
    assert 0.2 < np.linalg.norm(contact.position - [0.0, 0.0, 0.36]) < 0.9
    # The message has no numbers, so that a bag's reader sees one change.
    assert {entry.message for entry in watched.safety.messages} == {"monitoring", "contact"}
    watched.push(REST, 400)
    assert watched.last[:2] == (DiagnosticStatus.OK, "monitoring") and "contact link" not in watched.last[2]


def test_stop_is_an_error_with_its_reason_and_is_latched(watched):
    watched.push(3.0 * LIGHT, 60)
    level, message, values = watched.last
    assert level == DiagnosticStatus.ERROR and message.startswith("sudden external torque on lbr_A")
    assert values["level"] == "collision" and float(values["contact force N"]) > 20.0
    watched.push(REST, 400)
    assert watched.last[:2] == (level, message)
