"""From commanded poses to goals."""

from __future__ import annotations

from typing import Any

from contact_reach_ros.messages.values import quaternion, vector
from contact_reach_ros.world.task import POSE, Goal


def to_goal(message: Any, orientation: str) -> Goal:
    """The goal in a PoseStamped; `orientation` is one of `ORIENTATIONS`, 'pose' for that of the message."""
    pose = message.pose
    chosen = quaternion(pose.orientation) if orientation == POSE else orientation
    return Goal(vector(pose.position), chosen, frame=message.header.frame_id)
