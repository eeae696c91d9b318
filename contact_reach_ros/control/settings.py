"""Settings of the controller; the planner reads the gains too, because it plans what the controller will do."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.settings import Settings, setting


@dataclass(frozen=True)
class ImpedanceSettings(Settings):
    """Gains of the laws (1) and (2); each multiplies the identity, as in the paper's Section V."""

    task_stiffness: float = setting(880.0, "Kp of law (1)", unit="1/s²", minimum=0.0, maximum=2500.0)
    task_damping: float = setting(100.0, "Kd of law (1)", unit="1/s", minimum=0.0, maximum=300.0)
    null_stiffness: float = setting(30.0, "Kqp of law (2)", unit="Nm/rad", minimum=0.0, maximum=200.0)
    null_damping: float = setting(1.0, "Kqd of law (2)", unit="Nm s/rad", minimum=0.0, maximum=50.0)
    singularity_floor: float = setting(
        0.03, "eigenvalues of J M⁻¹ Jᵀ below this are lifted, which bounds Λ", unit="1/kg", minimum=1e-6, maximum=1.0
    )


@dataclass(frozen=True)
class LimitSettings(Settings):
    """Limits on torques and joints."""

    torque_share: float = setting(0.9, "torque cap as a share of the data sheet's", minimum=0.05, maximum=1.0)
    torque_rate: float = setting(
        4000.0,
        "greatest change of A1's torque; that of the others is in proportion to their torque limits",
        unit="Nm/s",
        minimum=1.0,
        maximum=20000.0,
    )
    joint_limit_margin: float = setting(
        0.1, "distance to a position limit at which repulsion begins", unit="rad", minimum=0.01, maximum=0.5
    )
    joint_limit_torque_share: float = setting(
        0.5, "repulsion at the position limit, as a share of the joint's torque limit", minimum=0.0, maximum=1.0
    )
    joint_limit_damping: float = setting(
        10.0,
        "damping at the limit of A1's motion towards it; that of the others is in proportion to their torque limits",
        unit="Nm s/rad",
        minimum=0.0,
        maximum=50.0,
    )
    null_velocity_share: float = setting(
        0.3,
        "joint speed beyond which motion in the null space is braked, as a share of the data sheet's limit",
        minimum=0.05,
        maximum=1.0,
    )
    velocity_limit_share: float = setting(
        0.9,
        "joint speed beyond which no joint is driven, as a share of the data sheet's limit",
        minimum=0.05,
        maximum=1.0,
    )
    velocity_limit_rate: float = setting(
        100.0,
        "greatest acceleration per speed below that, and deceleration above",
        unit="1/s",
        minimum=1.0,
        maximum=500.0,
    )


@dataclass(frozen=True)
class SupervisionSettings(Settings):
    """Plan age, start and stop."""

    shadow: bool = setting(
        False, "compute everything, but publish the torques on shadow/commands, where nobody acts on them"
    )
    gravity_compensation: bool = setting(True, "send g(q); false for arms that compensate gravity themselves")
    start_ramp: float = setting(0.5, "time in which the laws get full authority", unit="s", minimum=0.0, maximum=5.0)
    hold_blend: float = setting(
        0.3, "time in which the reference decays to the pose at hand", unit="s", minimum=0.01, maximum=2.0
    )
    hold_limit: float = setting(
        5.0, "time without a valid plan, after one, until the compliant stop", unit="s", minimum=0.1, maximum=3600.0
    )
    observer_timeout: float = setting(
        0.05, "silence of the observer that stops the arm", unit="s", minimum=0.005, maximum=1.0
    )
    max_plan_lead: float = setting(
        1.0, "a plan that takes effect later than this is refused", unit="s", minimum=0.0, maximum=10.0
    )
    stop_damping: float = setting(
        20.0,
        "damping of A1 in the compliant stop; that of the others is in proportion to their torque limits",
        unit="Nm s/rad",
        minimum=0.0,
        maximum=50.0,
    )
    rest_within: float = setting(
        0.5,
        "time after a stop in which the arm has to come to rest; otherwise nothing is commanded any more, so that the "
        "drive's watchdog takes over",
        unit="s",
        minimum=0.05,
        maximum=10.0,
    )
    stop_speed_gain: float = setting(
        0.5,
        "the same happens when the fastest joint gets faster by this than it has been since the stop",
        unit="rad/s",
        minimum=0.05,
        maximum=3.0,
    )
    reset_velocity: float = setting(
        0.05,
        "joint speed below which the arm is at rest, and a stop may be reset",
        unit="rad/s",
        minimum=0.0,
        maximum=1.0,
    )
    velocity_share: float = setting(
        1.0, "joint speed that stops the arm, as a share of the data sheet's limit", minimum=0.05, maximum=1.0
    )
    velocity_debounce: int = setting(3, "states in a row above that speed that stop the arm", minimum=1, maximum=100)
