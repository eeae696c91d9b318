"""Conversion of settings into the constants of the compiled arithmetic."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.control.kernels import Constant
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.control.stability import lightness, stable_damping
from contact_reach_ros.timing import PERIOD


def make_constants(
    arm: Arm,
    impedance: ImpedanceSettings | None = None,
    limits: LimitSettings | None = None,
    supervision: SupervisionSettings | None = None,
    period: float = PERIOD,
) -> Array:
    """Build the matrix (len(Constant), n) of `kernels.Constant`; settings that are not given have their defaults.

    `period`: nominal time between joint states, s, for which the damping of joints stays stable.
    """
    impedance, limits = impedance or ImpedanceSettings(), limits or LimitSettings()
    supervision = supervision or SupervisionSettings()
    torques, speeds = arm.torque_limits, arm.velocity_limits
    values: dict[Constant, Array | float] = {
        Constant.TASK_STIFFNESS: impedance.task_stiffness,
        Constant.TASK_DAMPING: impedance.task_damping,
        Constant.NULL_STIFFNESS: impedance.null_stiffness,
        Constant.NULL_DAMPING: impedance.null_damping,
        Constant.SINGULARITY_FLOOR: impedance.singularity_floor,
        Constant.LOWER_THRESHOLD: arm.lower + limits.joint_limit_margin,
        Constant.UPPER_THRESHOLD: arm.upper - limits.joint_limit_margin,
        Constant.REPULSION_MARGIN: limits.joint_limit_margin,
        Constant.REPULSION_STRENGTH: limits.joint_limit_torque_share * torques,
        Constant.REPULSION_DAMPING: stable_damping(
            limits.joint_limit_damping * torques / torques.max(), lightness(arm).mobility, period
        ),
        Constant.BRAKED_SPEED: limits.null_velocity_share * speeds,
        Constant.SPEED_CEILING: limits.velocity_limit_share * speeds,
        Constant.SPEED_RATE: limits.velocity_limit_rate,
        Constant.TORQUE_CAP: limits.torque_share * torques,
        Constant.TORQUE_RATE: torque_rates(arm, limits),
        Constant.GRAVITY_SHARE: float(supervision.gravity_compensation),
        Constant.STOP_DAMPING: stop_damping(arm, supervision),
        Constant.TASK_ROWS: impedance.rows,
    }
    return np.array([np.broadcast_to(values[row], arm.n) for row in Constant])


def torque_rates(arm: Arm, settings: LimitSettings) -> Array:
    """Greatest rate of change of each joint's torque (n,), N m/s, in proportion to the joints' torque limits."""
    return settings.torque_rate * arm.torque_limits / arm.torque_limits.max()


def stop_damping(arm: Arm, settings: SupervisionSettings) -> Array:
    """Damping (n,) of each joint in the compliant stop, N m s/rad."""
    # The wrist's inertia is small: with the damping of A1 it would swing up if a command came one tick late.
    return settings.stop_damping * arm.torque_limits / arm.torque_limits.max()
