"""Settings of the planner: the problem (4)-(5), its transfer model, Algorithm 1, and when plans are made."""

from __future__ import annotations

import math
from dataclasses import dataclass

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.settings import Sections, Settings, setting
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import HOLD, ORIENTATIONS

PIPELINES = ("closed_loop", "generalized")
BOUNDS, PAPER = SAMPLINGS = ("bounds", "paper")

ROTATION_BOUND = POSTURE_BOUND = 0.2
"""γ of the rotation in Δx, each axis, and of Δq, each joint, rad, as in the paper; the speed is up to Δx."""


@dataclass(frozen=True)
class PlanningSettings(Settings):
    """Everything that shapes a plan except the permitted contact force, which belongs to the contact budget."""

    horizon: int = setting(3, "H of (4): number of knots in a plan", minimum=1, maximum=12)
    knot_duration: float = setting(0.1, "time for which one knot is in force", unit="s", minimum=0.01, maximum=0.5)
    substeps: int = setting(4, "steps of the transfer model per knot", minimum=1, maximum=20)
    pipeline: str = setting(
        "closed_loop",
        "transfer model: this package's, or Brax's own for comparison, which is much slower",
        choices=PIPELINES,
    )
    goal_weight: float = setting(1.0, "λ1 of (5): distance to the goal", unit="1/m", minimum=0.0, maximum=100.0)
    progress_weight: float = setting(
        0.2, "λ2 of (5): distance from the start of the plan", unit="1/m", minimum=0.0, maximum=100.0
    )
    contact_limit_weight: float = setting(
        5.0, "λ3 of (5): contact force above the permitted one", unit="1/N", minimum=0.0, maximum=100.0
    )
    contact_weight: float = setting(
        0.01, "any contact force, so that permitted ones stay low", unit="1/N", minimum=0.0, maximum=100.0
    )
    contact_patience: float = setting(
        0.5,
        "delay behind a slow approach at which that weight has fallen to 1/e, since permitted contact must not keep "
        "the arm from its goal; 0 for never",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    orientation_weight: float = setting(
        0.2, "rotation error, for goals with an orientation", unit="1/rad", minimum=0.0, maximum=10.0
    )
    detour_patience: float = setting(
        1.0,
        "time without progress towards the goal, twice that close to it, after which the arm takes a detour through "
        "joint space to another posture in which it is at the goal; 0 for never",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    null_motion_weight: float = setting(
        0.003,
        "squared Δq, so that the elbow rests when nothing requires it to move",
        unit="1/rad²",
        minimum=0.0,
        maximum=1.0,
    )
    lead_change_weight: float = setting(
        200.0,
        "squared change of x_d's distance from the flange, so that plans do not jerk the arm",
        unit="1/m²",
        minimum=0.0,
        maximum=10000.0,
    )
    translation_bound: float = setting(0.01, "γ of Δx, each axis", unit="m", minimum=0.001, maximum=0.1)
    population: int = setting(
        200,
        "k: candidates per step, of which the best quarter makes the next mean, and values of β tried along the "
        "gradient",
        minimum=8,
        maximum=20000,
    )
    sampling: str = setting(
        BOUNDS,
        "initial standard deviations and boundary penalty of candidates: relative to γ and to the spread of their "
        "costs, or as in lines 1 and 9 of Algorithm 1",
        choices=SAMPLINGS,
    )
    max_steps: int = setting(100, "solver steps in one plan", minimum=1, maximum=1000)
    deadline: float = setting(
        0.03,
        "wall-clock time for one plan; 0 for no limit, which makes plans reproducible",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )

    @property
    def elite(self) -> int:
        """k_top: candidates averaged into the next mean, the paper's quarter of k."""
        return self.population // 4


SPEED_SCALE = "speed_scale"
"""Name of the setting that may be changed while the planner runs."""

IGNORE, GIVE_WAY = REACTIONS = ("ignore", "give way")
"""Reaction to contact that no known obstacle explains."""


@dataclass(frozen=True)
class ReplanningSettings(Settings):
    """When plans are made, and when they take effect."""

    period: float = setting(0.03, "least time between plans", unit="s", minimum=0.005, maximum=1.0)
    latency: float = setting(
        0.04,
        "least time from a state to the effect of its plan; in simulated time exactly this time",
        unit="s",
        minimum=0.001,
        maximum=0.5,
    )
    speed_scale: float = setting(
        1.0,
        "share of γ that plans use, and so of the speed; may be changed while the node runs",
        minimum=0.01,
        maximum=1.0,
        changeable=True,
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
    """How the planner reacts to a contact that no known obstacle explains."""

    reaction: str = setting(
        GIVE_WAY,
        "reaction to contact within the budget that no known obstacle explains: none; or the goal is withdrawn, and "
        "the controller gives way",
        choices=REACTIONS,
    )


@dataclass(frozen=True)
class PlannerNodeSettings(ReplanningSettings):
    """When to plan, for which goals, and among which obstacles."""

    goal_orientation: str = setting(
        HOLD,
        "orientation of the goal: held as it is when the goal arrives, that of the pose, or free, and held once the "
        "tip is there",
        choices=ORIENTATIONS,
    )
    max_spheres: int = setting(
        1, "nearest obstacle spheres that a plan takes into account; 0 plans without contact", minimum=0, maximum=64
    )
    sphere_stiffness: float = setting(
        100.0, "spring that holds an obstacle sphere in place", unit="N/m", minimum=1.0, maximum=5000.0
    )
    edge_stiffness: float = setting(
        60.0, "spring between two nodes joined by an edge", unit="N/m", minimum=1.0, maximum=5000.0
    )


PLANNER_SECTIONS: Sections = {
    "": PlannerNodeSettings,
    "unexpected_contact": UnexpectedContactSettings,
    "planning": PlanningSettings,
}
"""Settings of the planner's node by parameter prefix; the gains that it plans for are the controller's."""


def steady_speed(planning: PlanningSettings, impedance: ImpedanceSettings) -> float:
    """Greatest steady speed of an axis of the flange under law (1), m/s: γ Kp / Kd.

    At that speed the damping balances the stiffness, since γ bounds Δx. Infinite without damping.
    """
    pull = planning.translation_bound * impedance.task_stiffness
    if impedance.task_damping == 0.0:
        return math.inf if pull > 0.0 else 0.0
    return pull / impedance.task_damping
