"""The planner node and what the observer reports of contact within the budget."""

import numpy as np
import pytest
from arm_simulation import HOME, REST, TICK_NS
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message
from stack_helpers import hand_in, ros
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.nodes.planner import PlannerNode

FLANGE, _ = RobotModel(iiwa14.ARM).tip_pose(HOME)


class Planner:
    """A node that compiles nothing and so publishes no plans, with a goal for an arm at home."""

    def __init__(self) -> None:
        self.node = PlannerNode()
        self.node._make_plan = lambda _: None
        self._writer = JointStateWriter(iiwa14.ARM.joint_names, iiwa14.ARM.base_frame, ["position", "velocity"])
        self._tick = 0
        self.node._on_obstacles(serialize_message(MarkerArray()))
        self.state()
        self.goal()
        self.state()

    def state(self) -> None:
        self._tick += 40
        self.node._on_state(self._writer.write(self._tick * TICK_NS, HOME, REST))

    def goal(self) -> None:
        message = to_goal_pose([0.5, 0.1, 0.4], iiwa14.ARM.base_frame, Time())
        hand_in(self.node.inbox, topics.GOAL_POSE, serialize_message(message))

    def reported(self, **values: str) -> None:
        """The observer reports contact, with these values."""
        message = DiagnosticStatus(level=DiagnosticStatus.WARN, name="observer", message="contact")
        message.values = [KeyValue(key=key.replace("_", " "), value=value) for key, value in values.items()]
        hand_in(self.node.inbox, topics.SAFETY_STATE, serialize_message(message))
        self.state()

    def touched(self, force: str = "0 12 0") -> None:
        self.reported(
            contact_link="lbr_link_7", contact_force_xyz_N=force, contact_position_xyz_m=" ".join(map(str, FLANGE))
        )

    @property
    def planned_for(self) -> np.ndarray:
        return self.node._planner.reaction.goal(self.node._planner.goal).position


@pytest.fixture
def planner():
    with ros():
        yield Planner()


def test_a_contact_that_stays_leads_the_flange_back_until_there_is_another_goal(planner):
    np.testing.assert_allclose(planner.planned_for, [0.5, 0.1, 0.4])
    planner.touched()
    np.testing.assert_allclose(planner.planned_for, [0.5, 0.1, 0.4])
    planner.touched()
    np.testing.assert_allclose(planner.planned_for, FLANGE)
    assert planner.node.diagnosis()[0] == "retreat: unexpected contact at lbr_link_7, 12 N"
    planner.goal()
    np.testing.assert_allclose(planner.planned_for, [0.5, 0.1, 0.4])


def test_no_contact_and_one_that_is_none_change_nothing(planner):
    for _ in range(3):
        planner.reported(level="free")
        planner.touched("0 x 0")
    assert planner.node.refused == {"safety states": 3}
    np.testing.assert_allclose(planner.planned_for, [0.5, 0.1, 0.4])
