"""Endpoints that the quality of service keeps apart are named; obstacles are heard whoever sends them."""

import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from stack_helpers import Beside, ros
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import NEWEST
from contact_reach_ros.ros.graph import mismatches
from contact_reach_ros.ros.inbox import Inbox, qos_profile

KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PLAIN = QoSProfile(depth=10)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class Bench:
    """A node with an inbox, and another one beside it."""

    def __init__(self):
        self.node, self.other = rclpy.create_node("planner"), rclpy.create_node("stranger")
        self.heard, self.refused, self.counts = [], [], {}
        self.inbox = Inbox(self.node, lambda what, error: self.refused.append(str(error)))

    def look(self):
        return list(mismatches(self.node, self.inbox.subscriptions, self.counts))

    def until(self, holds):
        for _ in range(500):
            self.inbox.wait(20_000_000)
            if found := holds():
                return found
        pytest.fail("not within 10 s")

    def listen(self, topic, qos=None):
        self.inbox.add(topic, self.heard.append, qos)


@pytest.fixture
def bench():
    with ros():
        yield Bench()


@pytest.mark.parametrize(
    ("topic", "qos", "words"),
    [
        (topics.SAFETY_STATE, PLAIN, ("/safety_state", "Volatile publisher", "offer reliable, transient local")),
        (topics.GOAL_POSE, BEST_EFFORT, ("/goal_pose", "Best effort publisher", "offer reliable, volatile")),
        (topics.OBSTACLES, BEST_EFFORT, ("/obstacles", "Best effort publisher", "offer reliable")),
    ],
)
def test_a_publisher_that_is_not_heard_is_named_with_the_remedy_once(bench, topic, qos, words):
    bench.listen(topic)
    assert bench.look() == []
    _publisher = bench.other.create_publisher(topic.type, topic.name, qos)
    (line,) = bench.until(bench.look)
    assert "this node hears nothing from /stranger" in line and all(word in line for word in words)
    assert bench.look() == []


def test_a_subscription_that_does_not_hear_the_node_is_named(bench):
    _publisher = bench.node.create_publisher(MarkerArray, "plan/markers", PLAIN)
    _subscription = bench.other.create_subscription(MarkerArray, "plan/markers", print, KEPT)
    (line,) = bench.until(bench.look)
    assert line.startswith("/plan/markers: this node is not heard by /stranger (")
    assert line.endswith("let that one request at most reliable, volatile")


@pytest.mark.parametrize("qos", [KEPT, PLAIN], ids=["latched", "volatile"])
def test_what_fits_is_no_mismatch(bench, qos):
    bench.listen(topics.OBSTACLES)
    bench.listen(topics.GOAL_POSE)
    bench.listen(topics.JOINT_STATES, NEWEST)
    heard = [(topic, qos) for topic in (topics.OBSTACLES, topics.GOAL_POSE, topics.JOINT_STATES)]
    heard.append((topics.JOINT_STATES, BEST_EFFORT))
    publishers = [bench.other.create_publisher(topic.type, topic.name, offered) for topic, offered in heard]
    own = bench.node.create_publisher(MarkerArray, "plan/markers", KEPT)
    _subscription = bench.other.create_subscription(MarkerArray, "plan/markers", print, qos)
    bench.until(lambda: all(publisher.get_subscription_count() for publisher in (*publishers, own)))
    assert bench.look() == []


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


def test_a_managed_node_logs_it(capfd):
    from contact_reach_ros.nodes.observer import ObserverNode

    with ros():
        beside = Beside(ObserverNode())
        topic = topics.EXTERNAL_TORQUE
        _subscription = beside.other.create_subscription(topic.type, topic.name, print, KEPT)
        said = "/external_torque: this node is not heard by /intruder"
        beside.until(lambda: said in capfd.readouterr().err, "the node says it")
