"""Settings of the planner's node."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.settings import Sections, Settings, setting
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import ANGLE_TOLERANCE, HOLD, ORIENTATIONS, REST_SPEED, TOLERANCE

SPEED_SCALE = "speed_scale"
"""Name of the setting that may be changed while the planner runs."""

IGNORE, RETREAT = REACTIONS = ("ignore", "retreat")
"""Reaction to contact that no known obstacle explains."""


@dataclass(frozen=True)
class ReplanningSettings(Settings):
    """When plans are made, and when they take effect."""

    period: float = setting(0.03, "least time between plans", unit="s", minimum=0.005, maximum=1.0)
    latency: float = setting(
        0.04,
        "least time from a state to the effect of its plan; in lockstep exactly this time",
        unit="s",
        minimum=0.001,
        maximum=0.5,
    )
    speed_scale: float = setting(
        1.0,
        "share of γ that plans use, and so of the speed; may be changed while the node runs",
        minimum=0.01,
        maximum=1.0,
    )
    max_obstacle_age: float = setting(
        0.5,
        "age of the obstacles beyond which goals and plans are refused, 0 for none",
        unit="s",
        minimum=0.0,
        maximum=3600.0,
    )
    require_obstacles: bool = setting(
        True, "refuse goals and plans before the first message of obstacles; false declares the scene empty until then"
    )
    settle_time: float = setting(
        0.2, "time at rest within the goal's tolerances after which it has settled", unit="s", minimum=0.0, maximum=10.0
    )
    goal_timeout: float = setting(
        0.0, "time without settling after which a goal is withdrawn, 0 for none", unit="s", minimum=0.0, maximum=3600.0
    )

    @property
    def period_ns(self) -> int:
        """`period` in ns."""
        return int(self.period * NANOSECONDS)

    @property
    def latency_ns(self) -> int:
        """`latency` in ns."""
        return int(self.latency * NANOSECONDS)


@dataclass(frozen=True)
class UnexpectedContactSettings(Settings):
    """When a contact that no known obstacle explains counts, and how the planner reacts to it."""

    reaction: str = setting(
        RETREAT,
        "reaction to contact within the budget that no known obstacle explains: none; or a retreat of the flange "
        "along its path, where the arm waits for another goal",
        choices=REACTIONS,
    )
    patience: float = setting(0.01, "least duration of the contact", unit="s", minimum=0.0, maximum=5.0)
    least_force: float = setting(5.0, "least force that counts", unit="N", minimum=0.0, maximum=140.0)
    retreat: float = setting(0.05, "distance of the retreat", unit="m", minimum=0.01, maximum=0.5)


@dataclass(frozen=True)
class PlannerNodeSettings(ReplanningSettings):
    """When to plan, for which goals, and among which obstacles."""

    goal_orientation: str = setting(
        HOLD,
        "orientation of the goal: held as it is when the goal arrives, that of the pose, or free",
        choices=ORIENTATIONS,
    )
    goal_tolerance: float = setting(
        TOLERANCE, "distance from a goal that counts as reached", unit="m", minimum=0.0001, maximum=1.0
    )
    goal_angle_tolerance: float = setting(
        ANGLE_TOLERANCE, "angle from its orientation with which it has settled", unit="rad", minimum=0.001, maximum=3.2
    )
    rest_speed: float = setting(
        REST_SPEED, "speed of the flange up to which it is at rest", unit="m/s", minimum=0.0001, maximum=1.0
    )
    contact_budget: str = setting("", "contact budget YAML; the package's own when empty")
    max_spheres: int = setting(
        1, "nearest obstacle spheres that a plan takes into account; 0 plans without contact", minimum=0, maximum=64
    )
    sphere_stiffness: float = setting(
        100.0, "spring that holds an obstacle sphere in place", unit="N/m", minimum=1.0, maximum=5000.0
    )
    sphere_damping: float = setting(
        30.0, "damping of an obstacle sphere's motion", unit="N s/m", minimum=0.1, maximum=500.0
    )
    node_stiffness: float = setting(
        0.0, "spring that holds a movable node of a deformable body in place", unit="N/m", minimum=0.0, maximum=5000.0
    )
    node_damping: float = setting(5.0, "damping of a node's motion", unit="N s/m", minimum=0.1, maximum=500.0)
    edge_stiffness: float = setting(
        60.0, "spring between two nodes joined by an edge", unit="N/m", minimum=1.0, maximum=5000.0
    )


PLANNER_SECTIONS: Sections = {
    "": PlannerNodeSettings,
    "unexpected_contact": UnexpectedContactSettings,
    "planning": PlanningSettings,
}
"""Settings of the planner's node by parameter prefix; the gains that it plans for are the controller's."""
