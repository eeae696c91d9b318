"""Conversion of settings into the constants of the compiled arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.kinematics import vector
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.kernels import REPULSION_MARGIN, Constant
from contact_reach_ros.control.settings import (
    IMPACT_ENERGY,
    JOINT_SHARE,
    SINGULARITY_FLOOR,
    ImpedanceSettings,
    LimitSettings,
    SupervisionSettings,
)
from contact_reach_ros.control.stability import lightness, stable_damping
from contact_reach_ros.timing import PERIOD

REPULSION_SHARE = 0.5
"""Repulsion at the position limit, as a share of the joint's torque limit: the other half is left to carry the arm."""
REPULSION_DAMPING = 10.0
"""Damping of motion towards a limit, at the limit, N m s/rad, for the strongest joint; the others' are in proportion to
their torque limits. Without it the repulsion would throw the joint back."""

STOP_DELAY = 0.01
"""Delay of the drive and its filters that a stop stays stable with, besides a period, s, unless it has a longer one."""
STOP_SHARE = 0.8
"""Share of an arm's speed that the stop's damping takes within period and delay: 1.3 is unstable."""


def make_constants(
    arm: Arm,
    impedance: ImpedanceSettings | None = None,
    limits: LimitSettings | None = None,
    supervision: SupervisionSettings | None = None,
    period: float = PERIOD,
    hold: Sequence[float] | None = None,
) -> Array:
    """Build the matrix (len(Constant), n) of `kernels.Constant`; settings that are not given have their defaults.

    `period`: nominal time between joint states, s, for which the damping of joints stays stable; `hold`: torques (n,),
    N m, that a stop and the laws always hold, the arm's limits at hand-over by default.
    """
    impedance, limits = (impedance or ImpedanceSettings()).resolve(arm), limits or LimitSettings()
    supervision = supervision or SupervisionSettings()
    torques, speeds = arm.torque_limits, arm.velocity_limits
    values: dict[Constant, Array | float] = {
        Constant.TASK_STIFFNESS: impedance.task_stiffness,
        Constant.TASK_DAMPING: impedance.task_damping,
        Constant.NULL_STIFFNESS: impedance.null_stiffness,
        Constant.NULL_DAMPING: impedance.null_damping,
        Constant.SINGULARITY_FLOOR: SINGULARITY_FLOOR,
        Constant.LOWER_THRESHOLD: arm.lower + REPULSION_MARGIN,
        Constant.UPPER_THRESHOLD: arm.upper - REPULSION_MARGIN,
        Constant.REPULSION_STRENGTH: REPULSION_SHARE * torques,
        Constant.REPULSION_DAMPING: stable_damping(
            REPULSION_DAMPING * torques / torques.max(), lightness(arm).mobility, period + limits.torque_delay
        ),
        Constant.TORQUE_CAP: limits.torque_share * torques,
        Constant.TORQUE_RATE: torque_rates(arm, limits),
        Constant.GRAVITY_SHARE: float(supervision.gravity_compensation),
        Constant.STOP_RATE: STOP_SHARE / (period + max(STOP_DELAY, limits.torque_delay)),
        Constant.TASK_ROWS: impedance.rows,
        Constant.TIP_FORCE: limits.tip_force,
        Constant.BODY_SPEED: limits.body_speed,
        Constant.JOINT_SPEED: JOINT_SHARE * speeds,
        Constant.IMPACT_ENERGY: IMPACT_ENERGY,
        Constant.TORQUE_DELAY: limits.torque_delay,
        Constant.HOLD: np.array(arm.default("handover_thresholds") if hold is None else hold),
    }
    return np.array([np.broadcast_to(values[row], arm.n) for row in Constant])


class Body(NamedTuple):
    """Where the arm's joints are on each other, and points of it whose speed is limited.

    Attributes
    ----------
    placements
        (3 n, 4): of each joint's frame in that of the joint before it, rotation and translation, m; it turns about z.
    links, points
        (P,) indices of joints, and (P, 3) points that they move, m, in their frames: ends and middles of the capsules'
        axes, and the tip.
    """

    placements: Array
    links: Array
    points: Array


def body_of(model: RobotModel) -> Body:
    """The body of an arm."""
    arm, joints = model.arm, model.pinocchio
    frames = [joints.jointPlacements[joints.getJointId(name)] for name in arm.joint_names]
    placements = np.vstack([np.column_stack([frame.rotation, frame.translation]) for frame in frames])
    axes = [(capsule.link - 1, np.array(capsule.start), np.array(capsule.end)) for capsule in arm.capsules]
    # Between its ends a link may be lighter. A tool may have no capsule.
    along = [(link, vector(start + share * (end - start))) for link, start, end in axes for share in (0.0, 0.5, 1.0)]
    links, points = zip(*dict.fromkeys([*along, (arm.n - 1, arm.tip_offset)]), strict=True)
    return Body(placements, np.array(links, float), np.array(points, float))


def torque_rates(arm: Arm, settings: LimitSettings) -> Array:
    """Greatest rate of change of each joint's torque (n,), N m/s, in proportion to the joints' torque limits."""
    return settings.torque_rate * arm.torque_limits / arm.torque_limits.max()
