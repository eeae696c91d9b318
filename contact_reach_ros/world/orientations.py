"""Orientations that a goal may ask for."""

HOLD, POSE, FREE = ORIENTATIONS = ("hold", "pose", "free")
"""Orientation of a goal: held as it is when the goal is given, that of a commanded pose, or free."""
