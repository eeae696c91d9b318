"""What the observer node publishes in safety_state, from joint states to messages."""

from collections.abc import Iterator

import numpy as np
import pytest
from arm_simulation import HOME, REST, TICK_NS
from diagnostic_msgs.msg import DiagnosticStatus
from stack_helpers import Published, ros

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.safety_state import DISTRUST, read_contact
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.observer.budget import ContactBudget

BUDGET = ContactBudget().resolve(iiwa14.ARM)
LIGHT = np.array([0.0, 5.0, 0.0, 4.0, 0.0, 0.0, 0.0])
UNKNOWN = np.full(7, np.nan)


class Watched:
    """An observer node that is given joint states of an arm at rest at home."""

    def __init__(self) -> None:
        self.node = ObserverNode()
        self.safety = self.node._safety = Published()
        self._writer = JointStateWriter(
            iiwa14.ARM.joint_names, iiwa14.ARM.base_frame, ["position", "velocity", "effort"]
        )
        self._gravity = RobotModel(iiwa14.ARM).gravity_at(HOME)
        self._tick = 0

    def give(self, external: np.ndarray, count: int, velocity: np.ndarray = REST) -> None:
        for _ in range(count):
            self._tick += 1
            # As encoders tell an arm at rest; without any tremor they would be stuck.
            q = HOME + 1e-5 * (self._tick % 2)
            data = self._writer.write(self._tick * TICK_NS, q, velocity, self._gravity - external)
            self.node.inbox.give(topics.JOINT_STATES, data)

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
    assert (level, message) == (DiagnosticStatus.WARN, "contact")
    assert values["level"] == "contact"
    assert values["contact link"] in iiwa14.ARM.link_names[1:]
    assert float(values["contact force N"]) > 5.0
    contact = read_contact(watched.safety.messages[-1], iiwa14.ARM)
    assert contact.link == values["contact link"]
    assert contact.strength == pytest.approx(float(values["contact force N"]), abs=0.2)
    # On the axis of a link near home's flange, and not at the base.
    assert 0.2 < np.linalg.norm(contact.position - [0.0, 0.0, 0.36]) < 0.9
    # The message has no numbers, so that a bag's reader sees one change.
    assert {entry.message for entry in watched.safety.messages} == {"monitoring", "contact"}
    watched.give(REST, 400)
    assert watched.last[:2] == (DiagnosticStatus.OK, "monitoring")
    assert "contact link" not in watched.last[2]


def test_contact_is_told_at_once(watched):
    watched.give(LIGHT * 3.0, 8)
    # Not at a multiple of the heartbeat.
    assert [entry.level for entry in watched.safety.messages].count(DiagnosticStatus.WARN) == 1


def test_stop_is_an_error_with_its_reason_and_link(watched):
    watched.give(3.0 * LIGHT, 60)
    level, message, values = watched.last
    assert level == DiagnosticStatus.ERROR
    assert message.startswith("sudden external torque on lbr_A")
    assert values["level"] == "collision"
    assert float(values["contact force N"]) > 20.0
    watched.give(REST, 400)
    assert watched.last[:2] == (level, message)


def test_unknown_weight_at_hand_over_is_an_error(watched):
    watched.give(UNKNOWN, 5)
    watched.give(1.2 * np.array(BUDGET.handover_thresholds)[1] * np.eye(7)[1], 200)
    assert watched.last[0] == DiagnosticStatus.ERROR
    assert "at hand-over the external torque on lbr_A2" in watched.last[1]
    assert watched.last[2][DISTRUST] == watched.last[1]


def test_torque_of_which_a_part_is_not_finite_is_refused(watched):
    external = np.zeros(7)
    external[3] = np.nan
    watched.give(external, 3)
    _, values = watched.node.diagnosis()
    assert values["refused states"] == 3
    watched.give(REST, 50)
    assert watched.last[:2] == (DiagnosticStatus.OK, "monitoring")
    assert np.isfinite(float(watched.last[2]["external torque max Nm"]))
    assert values["contacts"] == 0


def test_contact_that_is_none_is_refused(watched):
    watched.give(LIGHT, 60)
    message = watched.safety.messages[-1]
    assert read_contact(watched.safety.messages[0], iiwa14.ARM) is None
    link, force, place = "contact link", "contact force xyz N", "contact position xyz m"
    keys = [entry.key for entry in message.values]
    for key, spoilt in ((link, "lbr_link_9"), (force, "1 2"), (place, "1 2 x"), (place, "nan 0 0")):
        entry = keys.index(key)
        kept, message.values[entry].value = message.values[entry].value, spoilt
        with pytest.raises(InputError, match="safety_state: contact"):
            read_contact(message, iiwa14.ARM)
        message.values[entry].value = kept


def test_joint_states_that_cannot_be_true_stop_the_arm_and_are_named(watched):
    # The last joint, whose momentum is small.
    watched.give(REST, 200, velocity=0.2 * np.eye(7)[6])
    level, message, values = watched.last
    assert level == DiagnosticStatus.ERROR
    assert message.startswith("position and velocity of lbr_A7 differ by -0.02") and values[DISTRUST] == message


def test_old_joint_states_are_left_out_and_counted(watched):
    newest = watched._tick
    for _ in range(5):
        watched._tick = newest - 10
        watched.give(10.0 * LIGHT, 1)
        watched._tick = newest - 1
        watched.give(10.0 * LIGHT, 1)
        watched._tick = newest
        newest += 1
        watched.give(REST, 1)
    values = watched.node.diagnosis()[1]
    assert (values["joint states older"], values["joint states repeated"]) == (5, 5)
    assert watched.last[:2] == (DiagnosticStatus.OK, "monitoring")
