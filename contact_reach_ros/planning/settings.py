"""Settings of the planner: the optimisation problem (4)-(5), its transfer model and Algorithm 1."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.runtime import DEVICES
from contact_reach_ros.planning.solver import SOLVERS
from contact_reach_ros.settings import Settings, setting

PIPELINES = ("closed_loop", "generalized")
BOUNDARY_PENALTIES = ("quadratic", "paper")
SAMPLINGS = ("bounds", "paper")
CONTACT_MEASURES = ("largest", "sum")
NULL_SPACES = ("planned", "reference_posture")


@dataclass(frozen=True)
class PlanningSettings(Settings):
    """Everything that shapes a plan except the permitted contact force, which belongs to the contact budget."""

    horizon: int = setting(3, "H of (4): number of knots in a plan", minimum=1, maximum=10)
    knot_duration: float = setting(0.1, "time for which one knot is in force", unit="s", minimum=0.02, maximum=0.5)
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
    contact_measure: str = setting("largest", "contact(·) of (5) over the links", choices=CONTACT_MEASURES)
    orientation_weight: float = setting(
        0.2, "rotation error, for goals with an orientation", unit="1/rad", minimum=0.0, maximum=10.0
    )
    detour_weight: float = setting(
        0.5,
        "on a detour, distance of the joints from its posture, in place of the goal's terms; 0 for no detours",
        unit="1/rad",
        minimum=0.0,
        maximum=10.0,
    )
    detour_patience: float = setting(
        1.0,
        "time without progress towards the goal after which the arm takes a detour, straight through joint space to "
        "another posture in which it is at the goal; 0 for never",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    joint_limit_weight: float = setting(
        20.0, "squared intrusion of a joint into its limit margin", unit="1/rad²", minimum=0.0, maximum=1000.0
    )
    joint_limit_margin: float = setting(
        0.1, "distance to a joint limit at which its cost starts", unit="rad", minimum=0.0, maximum=1.0
    )
    joint_speed_weight: float = setting(
        0.3,
        "squared excess of a joint's mean speed over a knot above its limit",
        unit="s²/rad²",
        minimum=0.0,
        maximum=100.0,
    )
    clearance_weight: float = setting(
        100.0,
        "squared intrusion of the arm into the margin around rigid bodies and its own links; 0 leaves it out",
        unit="1/m²",
        minimum=0.0,
        maximum=10000.0,
    )
    clearance_margin: float = setting(
        0.02,
        "distance from rigid bodies and its own links at which that cost starts",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    collision_tolerance: float = setting(
        0.002,
        "predicted depth in a rigid body, or of the arm in itself, from which on a plan is refused unless it leads out",
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )
    null_motion_weight: float = setting(
        0.003,
        "squared Δq, so that the elbow rests when nothing requires it to move",
        unit="1/rad²",
        minimum=0.0,
        maximum=1.0,
    )
    lead_change_weight: float = setting(
        100.0,
        "squared change of x_d's distance from the flange, so that plans do not jerk the arm",
        unit="1/m²",
        minimum=0.0,
        maximum=10000.0,
    )
    null_space: str = setting(
        "planned",
        "what moves the redundant joints: Δq of the plan, or law (6) for comparison: a steady pull to one posture",
        choices=NULL_SPACES,
    )
    reference_posture: tuple[float, ...] | None = setting(
        None, "q_d of law (6), null for zeros", unit="rad", per_joint=True
    )
    translation_bound: float = setting(0.01, "γ of Δx, each axis", unit="m", minimum=0.001, maximum=0.1)
    rotation_bound: float = setting(0.2, "γ of the rotation in Δx, each axis", unit="rad", minimum=0.001, maximum=1.0)
    posture_bound: float = setting(0.2, "γ of Δq, each joint", unit="rad", minimum=0.001, maximum=1.0)
    contact_stiffness: float = setting(
        1000.0, "force per penetration between a link and a sphere", unit="N/m", minimum=10.0, maximum=100000.0
    )
    solver: str = setting(
        "hybrid", "Algorithm 1, or the same without or with many gradient steps", choices=tuple(SOLVERS)
    )
    gradient_steps: int = setting(10, "gradient steps per solver step of 'gradient'", minimum=2, maximum=100)
    population: int = setting(200, "k: candidates per step", minimum=4, maximum=20000)
    elite: int = setting(50, "k_top: candidates averaged into the next mean", minimum=2, maximum=10000)
    line_search_points: int = setting(200, "values of β tried along the gradient", minimum=2, maximum=20000)
    sampling: str = setting(
        "bounds",
        "initial standard deviations: a share of γ, or 0.01 for every variable as in line 1 of Algorithm 1",
        choices=SAMPLINGS,
    )
    sigma: float = setting(
        0.3, "initial standard deviation of the candidates as a share of γ", minimum=0.01, maximum=2.0
    )
    boundary_penalty: str = setting(
        "quadratic", "for candidates outside γ: squared distance, or line 9 of Algorithm 1", choices=BOUNDARY_PENALTIES
    )
    boundary_weight: float = setting(
        0.3,
        "quadratic penalty at a distance of γ, relative to the spread of the elite's costs",
        minimum=0.0,
        maximum=10.0,
    )
    max_steps: int = setting(100, "solver steps in one plan", minimum=1, maximum=1000)
    stagnation_tolerance: float = setting(
        1e-4, "decrease of the cost below which a step counts as stagnant", minimum=0.0, maximum=0.1
    )
    stagnation_steps: int = setting(3, "stagnant steps in a row that end the search", minimum=1, maximum=100)
    deadline: float = setting(
        0.03,
        "wall-clock time for one plan; 0 for no limit, which makes plans reproducible",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    device: str = setting(
        "auto", "device that computes plans; 'auto' is a GPU where JAX has one, else the CPU", choices=DEVICES
    )
    seed: int = setting(0, "seed of the candidates", minimum=0, maximum=2**31 - 1)

    @property
    def takes_detours(self) -> bool:
        """Whether plans may lead through another posture, which law (6), with one of its own, cannot follow."""
        return self.detour_patience > 0.0 and self.detour_weight > 0.0 and self.null_space == "planned"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.elite >= self.population:
            raise SettingsError(
                f"PlanningSettings.elite = {self.elite}: expected less than the population, {self.population}"
            )
