"""From commanded poses to goals."""

from __future__ import annotations

from typing import Any

from contact_reach_ros.messages.values import quaternion, vector
from contact_reach_ros.planning.settings import PlannerNodeSettings
from contact_reach_ros.world.goal import POSE, Goal


def to_goal(message: Any, settings: PlannerNodeSettings) -> Goal:
    """The goal in a PoseStamped; the settings give its tolerances, and whether its orientation counts."""
    pose, orientation = message.pose, settings.goal_orientation
    return Goal(
        vector(pose.position),
        quaternion(pose.orientation) if orientation == POSE else orientation,
        frame=message.header.frame_id,
        tolerance=settings.goal_tolerance,
    )
