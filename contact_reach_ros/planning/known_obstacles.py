"""The obstacles as they were seen last, and whether that still says where they are."""

from __future__ import annotations

from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.spheres import Spheres


class KnownObstacles:
    """Obstacles that go stale.

    Attributes
    ----------
    spheres
        As they were seen last; none before.
    are_seen
        Whether they were seen at all.
    """

    def __init__(self, max_age: float, required: bool) -> None:
        """Before anything is seen, the scene counts as empty, unless obstacles are `required`.

        Parameters
        ----------
        max_age
            Age beyond which they are stale, s; 0 for none.
        required
            Whether nothing is known of the scene before they are seen.
        """
        self.spheres = Spheres.none()
        self.are_seen = False
        self._max_age = max_age
        self._required = required
        self._stamp_ns: int | None = None

    def see(self, spheres: Spheres, stamp_ns: int | None) -> None:
        """Take the obstacles as they were at `stamp_ns`; None stands for the next `advance`."""
        self.spheres, self.are_seen, self._stamp_ns = spheres, True, stamp_ns

    def advance(self, now_ns: int) -> None:
        """Take note of the time: nothing was seen later than now, as a clock set back or another clock may say."""
        if self._stamp_ns is None or self._stamp_ns > now_ns:
            self._stamp_ns = now_ns

    def age(self, now_ns: int) -> float:
        """How old they are, s; NaN before they are seen."""
        if not self.are_seen:
            return float("nan")
        return 0.0 if self._stamp_ns is None else max(now_ns - self._stamp_ns, 0) / NANOSECONDS

    def problem(self, now_ns: int) -> str:
        """Why nothing can be planned among them, and what to do about it; empty if it can."""
        if not self.are_seen:
            if not self._required:
                return ""
            return (
                "obstacles: none received yet; expected a message, empty where nothing is in the way: start what "
                "publishes them, or set require_obstacles to false for a scene without any"
            )
        age = self.age(now_ns)
        if not 0.0 < self._max_age < age:
            return ""
        return (
            f"obstacles: last seen {age:.3f} s ago; expected max_obstacle_age, {self._max_age:g} s, at most: see that "
            "what publishes them runs and its clock agrees with the joint states', or raise max_obstacle_age"
        )
