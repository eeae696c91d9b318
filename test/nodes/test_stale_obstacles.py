"""The planner node makes no plan while it does not know where the obstacles are."""

import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import hand_in, ros
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.messages.obstacle_markers import obstacle_markers
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.spheres import rest_positions

BALL = load_scene("ball")
WRITER = JointStateWriter(ARM.joint_names, ARM.base_frame, ["position", "velocity"])


def goal() -> PoseStamped:
    return to_goal_pose(BALL.target.tolist(), ARM.base_frame, Time())


def ball(stamp_ns: int) -> bytes:
    return serialize_message(obstacle_markers(BALL, rest_positions(BALL), stamp_ns))


@pytest.fixture
def planner():
    """A node that compiles nothing and notes what it would solve; it knows the arm since tick 1000."""
    with ros():
        node = PlannerNode()
        node.asked = []
        node._make_plan = node.asked.append
        node.show = lambda tick: node._on_state(WRITER.write(tick * TICK_NS, HOME, REST))
        node.show(1000)
        yield node


def test_a_driver_publishes_a_scene_with_nothing_but_a_floor_again_and_again(monkeypatch):
    with ros("--ros-args", "-p", "scene:=free"):
        driver = DriverNode()
        shown = []
        monkeypatch.setattr(driver._obstacles, "publish", shown.append)
        for _ in range(100):
            driver._publish(driver.robot.read(), driver.robot.shows_obstacles())
            driver._tick(0)
        markers = [deserialize_message(data, MarkerArray).markers for data in shown]
        assert [[marker.text for marker in each] for each in markers] == 5 * [["floor"]]


def test_before_the_first_message_goals_are_refused_and_counted(planner):
    assert planner.diagnosis()[0] == topics.WAITING_FOR_OBSTACLES
    hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal()))
    assert planner.refused == {"goals": 1} and planner._planner.goal is None
    (refusal,) = planner.boundary.last_refusals()
    assert "obstacles: none received yet; expected a message, empty where" in refusal
    planner._on_obstacles(serialize_message(MarkerArray()))
    hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal()))
    planner.show(1001)
    assert len(planner.asked) == 1


def test_a_message_counts_from_the_stamps_of_its_markers(planner):
    for number, (stamp, refused) in enumerate([(499, 1), (500, 1), (0, 1)]):
        planner._on_obstacles(ball(stamp * TICK_NS))
        hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal()))
        assert planner.refused == {"goals": refused}, number
    (refusal,) = planner.boundary.last_refusals()
    assert "0.501 s ago; expected max_obstacle_age, 0.5 s" in refusal


def test_an_empty_message_counts_from_its_arrival_and_goes_stale_too(planner):
    planner._on_obstacles(serialize_message(MarkerArray()))
    hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal()))
    planner.show(1500)
    assert len(planner.asked) == 1 and not planner.refused
    for tick in range(1501, 1600):
        planner.show(tick)
    assert len(planner.asked) == 1
    assert planner.refused == {"plans": 3}
    summary, values = planner.diagnosis()
    assert summary.startswith("obstacles: last seen 0.599 s ago") and values["obstacle age s"] == pytest.approx(0.599)
    # New ones resume the plans for the same goal.
    planner._on_obstacles(ball(1599 * TICK_NS))
    planner.show(1640)
    assert len(planner.asked) == 2
