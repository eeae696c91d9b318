"""The control laws (1)-(3) and (6): operational-space impedance with null-space compliance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control import kernels
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.robot.model import RobotModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reference:
    """What the arm is to be pulled to: flange pose x_d in the base frame and joint posture q_d.

    Attributes
    ----------
    position
        (3,), m.
    rotation
        (3, 3).
    posture
        (7,), rad. All zeros makes law (2) the reference-posture law (6).
    """

    position: Array
    rotation: Array
    posture: Array


def pose_error(position: Array, rotation: Array, reference: Reference) -> Array:
    """Δx = x ⊖ x_d, (6,): translation in m, then the rotation vector of R R_dᵀ in rad, both in base axes."""
    return kernels.pose_error(position, rotation, reference.position, reference.rotation)


class ImpedanceLaw:
    """Law (3) = (1) + (2) for one robot model, without the limits that the controller adds.

    Two additions to the paper's equations, both documented in docs/control.md: Λ is bounded near singularities, and
    the drift J̇q̇ is compensated in task space, without which the error dynamics Δẍ + Kd Δẋ + Kp Δx = 0 holds only
    for slow motion.
    """

    def __init__(self, settings: ImpedanceSettings) -> None:
        self.settings = settings
        self._constants = make_constants(settings)

    def torque(self, model: RobotModel, v: Array, posture_error: Array, error: Array) -> Array:
        """τ of law (3) without the C + g of law (1), (7,), N m.

        Parameters
        ----------
        model
            Updated to the present state.
        v
            Joint velocities, (7,), rad/s.
        posture_error
            Δq = q − q_d, (7,), rad.
        error
            Δx, (6,), from `pose_error`.

        Raises
        ------
        FloatingPointError
            If the mass matrix is not positive definite.
        """
        factor, regular = kernels.factorise(model.mass_matrix, 0.0)
        if not regular:
            raise FloatingPointError("the mass matrix is not positive definite: the state is not finite")
        posture_torque = kernels.posture_torque(self._constants, posture_error, v)
        return kernels.law_torque(
            self._constants, factor, model.jacobian, model.twist, model.drift, error, posture_torque
        )
