"""Goals and obstacles in other frames than the arm's base frame, through tf2 where it is installed.

What comes in another frame is published again on its topic, in the base frame. So bags, viewer and re-execution have it
as the planner takes it, and need no transforms.
"""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped
from rclpy.lifecycle import LifecycleNode
from rclpy.time import Time
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.arm import Array, rotation_from_quaternion
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.conversions import to_point, to_quaternion
from contact_reach_ros.messages.topics import GOAL_POSE, OBSTACLES
from contact_reach_ros.messages.values import quaternion, vector
from contact_reach_ros.ros.inbox import qos_profile

try:
    import tf2_ros
except ImportError:
    tf2_ros = None


class Frames:
    """Publishes goals and obstacles again in the base frame.

    Parameters
    ----------
    node
        Lifecycle node that listens to `tf` and `tf_static`, if tf2_ros is installed.
    base_frame
        Frame to transform into.
    """

    def __init__(self, node: LifecycleNode, base_frame: str) -> None:
        self._base_frame = base_frame
        if tf2_ros is None:
            return
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self._goals, self._obstacles = (
            node.create_publisher(topic.type, topic.name, qos_profile(topic.qos)) for topic in (GOAL_POSE, OBSTACLES)
        )

    def is_foreign(self, header: Header) -> bool:
        """Whether something is in another frame; no frame at all stands for the base frame."""
        return header.frame_id not in ("", self._base_frame)

    def publish_goal(self, message: PoseStamped) -> None:
        """Publish a goal again in the base frame, which its orientation is turned into, too.

        Raises `InputError` if tf2 is not installed, or has no transform for the moment of the stamp.
        """
        message.pose = _moved(message.pose, *self._transform(message.header, "goal"))
        message.header.frame_id = self._base_frame
        self._goals.publish(message)

    def publish_obstacles(self, message: MarkerArray) -> None:
        """Publish obstacles again in the base frame, those in other frames moved.

        Raises `InputError` if tf2 is not installed, or has no transform for a marker; the marker is named.
        """
        for marker in message.markers:
            if marker.header.frame_id == self._base_frame:
                continue
            rotation, origin = self._transform(marker.header, f"obstacles: marker {marker.ns}/{marker.id}")
            if marker.points:
                points = np.array([vector(point) for point in marker.points]) @ rotation.T + origin
                marker.points = [to_point(point) for point in points.tolist()]
            else:
                marker.pose = _moved(marker.pose, rotation, origin)
            marker.header.frame_id = self._base_frame
        self._obstacles.publish(message)

    def _transform(self, header: Header, what: str) -> tuple[Array, Array]:
        """Rotation (3, 3) and origin (3,), m, of a frame in the base frame: at the stamp, or the latest without one."""
        frame, base = header.frame_id, self._base_frame
        if tf2_ros is None:
            raise InputError(f"{what}: frame '{frame}' is unknown; expected '{base}', or install tf2_ros")
        try:
            found = self._buffer.lookup_transform(base, frame, Time.from_msg(header.stamp)).transform
        except tf2_ros.TransformException as error:
            raise InputError(f"{what}: no transform from '{frame}' to '{base}': {str(error).strip()}") from error
        return rotation_from_quaternion(np.roll(quaternion(found.rotation), 1)), vector(found.translation)


def _moved(pose: Pose, rotation: Array, origin: Array) -> Pose:
    """A pose in another frame; an orientation that is none, as where nobody has set it, stays as it is."""
    position = to_point((rotation @ vector(pose.position) + origin).tolist())
    turn = quaternion(pose.orientation)
    if not turn.any():
        return Pose(position=position, orientation=pose.orientation)
    return Pose(position=position, orientation=to_quaternion(rotation @ rotation_from_quaternion(np.roll(turn, 1))))
