"""Goals and obstacles in other frames are published again in the base frame, where tf2_ros is installed."""

import sys
import types

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS
from geometry_msgs.msg import PoseStamped, Transform, TransformStamped, Vector3
from rclpy.serialization import serialize_message
from stack_helpers import hand_in, ros
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.arm.kinematics import rotation_about
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_marker, to_point, to_quaternion, to_time
from contact_reach_ros.messages.obstacle_markers import obstacle_markers
from contact_reach_ros.messages.serialized import JointStateWriter
from contact_reach_ros.messages.values import quaternion, vector
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros.frames import Frames
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.spheres import rest_positions

CAMERA = "camera"
TURN, ORIGIN = rotation_about((0.6, 0.0, 0.8), 0.7), np.array([0.4, -0.3, 0.9])
"""Where the camera is in the base frame."""
SEEN_NS = 7 * TICK_NS
WALL = load_scene("wall")


class TransformError(Exception):
    """As that of tf2."""


class Buffer:
    """As that of tf2_ros, with one transform, which is known at one time only."""

    def lookup_transform(self, target, source, time):
        if (target, source) != (ARM.base_frame, CAMERA) or time.nanoseconds not in (0, SEEN_NS):
            raise TransformError(f'"{source}" does not exist. ')
        return TransformStamped(
            transform=Transform(
                translation=Vector3(**dict(zip("xyz", ORIGIN.tolist(), strict=True))), rotation=to_quaternion(TURN)
            )
        )


@pytest.fixture
def tf2_ros(monkeypatch):
    """No registry has tf2 as wheels: the part of its interface that is used."""
    module = types.ModuleType("tf2_ros")
    module.Buffer, module.TransformListener, module.TransformException = Buffer, lambda *_: None, TransformError
    monkeypatch.setitem(sys.modules, "tf2_ros", module)


@pytest.fixture
def planner():
    """A node that knows the arm; what it would publish again is kept, and is not sent."""
    with ros():
        node = PlannerNode()
        state = JointStateWriter(ARM.joint_names, ARM.base_frame, ["position", "velocity"])
        node._on_state(state.write(8 * TICK_NS, HOME, REST))
        node._planner.see(node._obstacle_reader.read(serialize_message(MarkerArray())), None)
        node.again = []
        node._frames._goals = node._frames._obstacles = types.SimpleNamespace(publish=node.again.append)
        yield node


def goal(frame: str, stamp_ns: int = SEEN_NS) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id, message.header.stamp = frame, to_time(stamp_ns)
    message.pose.position = to_point(TURN.T @ (np.array([0.45, -0.14, 0.3]) - ORIGIN))
    message.pose.orientation = to_quaternion(TURN.T)
    return message


def test_a_goal_is_published_again_and_taken_then(tf2_ros, planner):
    hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal(CAMERA)))
    (again,) = planner.again
    assert planner._planner.goal is None and not planner.refused
    assert again.header.frame_id == ARM.base_frame and again.header.stamp == to_time(SEEN_NS)
    assert vector(again.pose.position) == pytest.approx([0.45, -0.14, 0.3], abs=1e-12)
    assert np.abs(quaternion(again.pose.orientation)) == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-12)
    hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(again))
    assert planner._planner.goal.position == pytest.approx([0.45, -0.14, 0.3])


@pytest.mark.parametrize(("frame", "stamp_ns"), [("elsewhere", SEEN_NS), (CAMERA, 9 * TICK_NS)])
def test_without_a_transform_a_goal_is_refused_with_its_reason(tf2_ros, planner, frame, stamp_ns):
    hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal(frame, stamp_ns)))
    (refusal,) = planner.boundary.last_refusals()
    assert f"goal: no transform from '{frame}' to '{ARM.base_frame}': \"{frame}\" does not exist." in refusal
    assert planner.refused == {"goals": 1} and not planner.again


def test_without_tf2_other_frames_are_refused(planner, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    planner._frames = Frames(planner, ARM.base_frame)
    markers = obstacle_markers(WALL, rest_positions(WALL), SEEN_NS)
    markers.markers[0].header.frame_id = CAMERA
    hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal(CAMERA)))
    hand_in(planner.inbox, topics.OBSTACLES, serialize_message(markers))
    assert planner.refused == {"goals": 1, "obstacles": 1}
    assert all("frame 'camera' is unknown; expected 'lbr_link_0'" in line for line in planner.boundary.last_refusals())


def test_obstacles_of_any_kind_are_where_they_were(tf2_ros, planner):
    """Walls, as lists of points, and the floor, as a turned box; those already in the base frame stay."""
    expected = obstacle_markers(WALL, rest_positions(WALL), SEEN_NS)
    ball = to_marker("obstacles", 99, 2, 3 * [0.1], (1, 1, 1, 1))
    ball.header.frame_id, ball.header.stamp, ball.pose.position = ARM.base_frame, to_time(SEEN_NS), to_point([1, 2, 3])
    expected.markers.append(ball)
    truth = planner._obstacle_reader.read(serialize_message(expected))
    for marker in expected.markers[:-1]:
        marker.header.frame_id = CAMERA
        marker.points = [to_point(TURN.T @ (vector(point) - ORIGIN)) for point in marker.points]
        if not marker.points:
            marker.pose.position = to_point(TURN.T @ (vector(marker.pose.position) - ORIGIN))
            marker.pose.orientation = to_quaternion(TURN.T)
    hand_in(planner.inbox, topics.OBSTACLES, serialize_message(expected))
    assert not planner.refused
    moved = planner._obstacle_reader.read(serialize_message(planner.again[0]))
    assert np.abs(moved.center - truth.center).max() < 1e-9 and np.array_equal(moved.edges, truth.edges)
    for body, other in zip(moved.environment, truth.environment, strict=True):
        assert body.point == pytest.approx(other.point) and body.normal == pytest.approx(other.normal)
