"""The planner node and what the observer tells it of contact within the budget."""

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME, REST, TICK_NS
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from stack_helpers import environment

from contact_reach_ros.nodes.messages import to_point
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.serialized import JointStateWriter
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel

FLANGE, _ = RobotModel().flange_pose(HOME)


class Planner:
    """A node that compiles nothing and so publishes no plans, with a goal for an arm at home."""

    def __init__(self) -> None:
        self.node = PlannerNode()
        self._writer = JointStateWriter(iiwa14.JOINT_NAMES, iiwa14.BASE_NAME, ["position", "velocity"])
        self._tick = 0
        self.state()
        self.goal()
        self.state()

    def state(self) -> None:
        self._tick += 40
        self.node._on_state(self._writer.write(self._tick * TICK_NS, HOME, REST))

    def goal(self) -> None:
        message = PoseStamped()
        message.header.frame_id = iiwa14.BASE_NAME
        message.pose.position = to_point([0.5, 0.1, 0.4])
        message.pose.orientation.w = 1.0
        self.node._on_goal(message)

    def told(self, **values: str) -> None:
        """The observer tells of contact, with these values."""
        message = DiagnosticStatus(level=DiagnosticStatus.WARN, name="observer", message="contact")
        message.values = [KeyValue(key=key.replace("_", " "), value=value) for key, value in values.items()]
        self.node._on_safety(message)
        self.state()

    def touched(self, force: str = "0 12 0") -> None:
        self.told(
            contact_link="lbr_link_7", contact_force_xyz_N=force, contact_position_xyz_m=" ".join(map(str, FLANGE))
        )

    @property
    def planned_for(self) -> np.ndarray:
        return self.node._reaction.goal(self.node._goal).position


@pytest.fixture
def planner():
    rclpy.init(domain_id=int(environment()["ROS_DOMAIN_ID"]))
    try:
        yield Planner()
    finally:
        rclpy.shutdown()


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
        planner.told(level="free")
        planner.touched("0 x 0")
    assert planner.node.refused == {"contacts": 3}
    np.testing.assert_allclose(planner.planned_for, [0.5, 0.1, 0.4])
