"""The kinds of obstacles in scene files, by the key of their section."""

from __future__ import annotations

from contact_reach_ros.world.kinds.ball import BallSettings
from contact_reach_ros.world.kinds.box import BoxSettings
from contact_reach_ros.world.kinds.wall import WallSettings
from contact_reach_ros.world.obstacle import ObstacleSettings

KINDS: dict[str, type[ObstacleSettings]] = {kind.KIND: kind for kind in (BallSettings, BoxSettings, WallSettings)}
"""A scene lists its obstacles in this order."""
