"""Publishers that the quality of service keeps away are logged; obstacles are heard whoever sends them."""

import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from stack_helpers import Beside, ros
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros.inbox import Inbox, qos_profile

KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PLAIN = QoSProfile(depth=10)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class Bench:
    """A node with an inbox, and another one beside it."""

    def __init__(self):
        self.node, self.other = rclpy.create_node("planner"), rclpy.create_node("stranger")
        self.heard, self.refused = [], []
        self.inbox = Inbox(self.node, lambda what, error: self.refused.append(str(error)))

    def until(self, holds):
        for _ in range(500):
            self.inbox.wait(20_000_000)
            if found := holds():
                return found
        pytest.fail("not within 10 s")

    def listen(self, topic):
        self.inbox.add(topic, self.heard.append)


@pytest.fixture
def bench():
    with ros():
        yield Bench()


def named(name):
    return MarkerArray(markers=[Marker(ns=name)])


@pytest.mark.parametrize("qos", [KEPT, PLAIN], ids=["latched", "volatile"])
def test_obstacles_are_heard_from_everybody_and_once(bench, qos):
    bench.listen(topics.OBSTACLES)
    publisher = bench.other.create_publisher(MarkerArray, "obstacles", qos)
    heard_by = 2 if qos is KEPT else 1
    bench.until(lambda: publisher.get_subscription_count() == heard_by)
    for number in range(20):
        publisher.publish(named(str(number)))
        bench.until(lambda: len(bench.heard) > number)  # noqa: B023
    for _ in range(10):
        bench.inbox.wait(20_000_000)
    assert [message.markers[0].ns for message in bench.heard] == [str(number) for number in range(20)]
    assert not bench.refused


def test_late_joiners_receive_latched_obstacles(bench):
    publisher = bench.other.create_publisher(MarkerArray, "obstacles", qos_profile(topics.OBSTACLES.qos))
    publisher.publish(named("early"))
    bench.listen(topics.OBSTACLES)
    assert bench.until(lambda: bench.heard)[0].markers[0].ns == "early"


@pytest.mark.parametrize(
    ("topic", "offered", "said"),
    [
        (topics.SAFETY_STATE, PLAIN, "discovered on topic 'safety_state', offering incompatible QoS"),
        (topics.OBSTACLES, BEST_EFFORT, "discovered on topic 'obstacles', offering incompatible QoS"),
        (topics.OBSTACLES, PLAIN, ""),
        (topics.OBSTACLES, KEPT, ""),
        (topics.JOINT_STATES, BEST_EFFORT, ""),
    ],
)
def test_a_publisher_that_a_node_does_not_hear_is_logged(capfd, topic, offered, said):
    with ros():
        beside = Beside(PlannerNode())
        publisher = beside.other.create_publisher(topic.type, topic.name, offered)
        if said:
            beside.until(lambda: said in capfd.readouterr().err, "the node says it")
        else:
            beside.until(publisher.get_subscription_count, "it is heard")
            for _ in range(20):
                beside.executor.spin_once(0.05)
            assert "New publisher" not in capfd.readouterr().err
