"""What the settings make of the constants of the compiled arithmetic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.kernels import Constant
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.robot import iiwa14

Array = NDArray[np.float64]


def make_constants(
    impedance: ImpedanceSettings | None = None,
    limits: LimitSettings | None = None,
    supervision: SupervisionSettings | None = None,
) -> Array:
    """The matrix (len(Constant), 7) of `kernels.Constant`; settings that are not given have their defaults."""
    impedance, limits = impedance or ImpedanceSettings(), limits or LimitSettings()
    supervision = supervision or SupervisionSettings()
    torques, speeds = np.array(iiwa14.TORQUE_LIMITS), np.array(iiwa14.VELOCITY_LIMITS)
    values = {
        Constant.TASK_STIFFNESS: impedance.task_stiffness,
        Constant.TASK_DAMPING: impedance.task_damping,
        Constant.NULL_STIFFNESS: impedance.null_stiffness,
        Constant.NULL_DAMPING: impedance.null_damping,
        Constant.SINGULARITY_FLOOR: impedance.singularity_floor,
        Constant.REPULSION_THRESHOLD: np.array(iiwa14.POSITION_LIMITS) - limits.joint_limit_margin,
        Constant.REPULSION_MARGIN: limits.joint_limit_margin,
        Constant.REPULSION_STRENGTH: limits.joint_limit_torque_share * torques,
        Constant.REPULSION_DAMPING: limits.joint_limit_damping * torques / torques.max(),
        Constant.BRAKED_SPEED: limits.null_velocity_share * speeds,
        Constant.SPEED_CEILING: limits.velocity_limit_share * speeds,
        Constant.SPEED_RATE: limits.velocity_limit_rate,
        Constant.TORQUE_CAP: limits.torque_share * torques,
        Constant.TORQUE_RATE: torque_rates(limits),
        Constant.GRAVITY_SHARE: float(supervision.gravity_compensation),
        Constant.STOP_DAMPING: stop_damping(supervision),
    }
    return np.array([np.broadcast_to(values[row], iiwa14.N_JOINTS) for row in Constant])


def torque_rates(settings: LimitSettings) -> Array:
    """Greatest change of each joint's torque (7,), N m/s: in proportion to the joints' torque limits."""
    limits = np.array(iiwa14.TORQUE_LIMITS)
    return settings.torque_rate * limits / limits.max()


def stop_damping(settings: SupervisionSettings) -> Array:
    """Damping (7,) of each joint in the compliant stop, N m s/rad."""
    limits = np.array(iiwa14.TORQUE_LIMITS)
    # The wrist's inertia is small: with the damping of A1 it would swing up if a command came one tick late.
    return settings.stop_damping * limits / limits.max()
