"""The control laws (1)-(3) and (6): operational-space impedance with null-space compliance.

On the 1 kHz path products are written `a.dot(b)`: for matrices this small it takes half the time of `a @ b`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.linalg import lapack

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.robot.model import RobotModel

Array = NDArray[np.float64]

_IDENTITY = np.eye(6)


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
    error = np.empty(6)
    error[:3] = position - reference.position
    error[3:] = pin.log3(rotation.dot(reference.rotation.T))
    return error


def bounded_inverse(matrix: Array, floor: float) -> Array:
    """Inverse of a symmetric positive semi-definite matrix whose norm stays at or below 2 / floor.

    Eigenvalues of at least `floor` are inverted exactly, so that the result is the true inverse away from
    singularities. Smaller ones are lifted to floor/2 · (1 + (s/floor)²), which meets s with the same slope at the
    floor: the result is continuously differentiable in the matrix.
    """
    # A Cholesky factor exists exactly when all eigenvalues are above the floor, and takes a fraction of their time.
    _, info = lapack.dpotrf(matrix - floor * _IDENTITY)
    if info == 0:
        return lapack.dposv(matrix, _IDENTITY)[1]
    values, vectors, info = lapack.dsyevd(matrix)
    if info != 0:
        raise FloatingPointError("the task-space inertia could not be decomposed: the state is not finite")
    if values[0] < floor:
        lifted = np.maximum(values, 0.0) / floor
        values = np.where(values < floor, 0.5 * floor * (1.0 + lifted * lifted), values)
    return (vectors / values).dot(vectors.T)


class ImpedanceLaw:
    """Law (3) = (1) + (2) for one robot model.

    Two additions to the paper's equations, both documented in docs/control.md: Λ is bounded near singularities, and
    the drift J̇q̇ is compensated in task space, without which the error dynamics Δẍ + Kd Δẋ + Kp Δx = 0 holds only
    for slow motion.
    """

    def __init__(self, settings: ImpedanceSettings) -> None:
        self.settings = settings
        self.task_inertia = np.eye(6)
        """Λ of the last call, (6, 6)."""
        self._inverse_mass_jacobian = np.zeros((7, 6))

    def torque(
        self, model: RobotModel, v: Array, posture_error: Array, error: Array, brake: Array | None = None
    ) -> Array:
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
        brake
            More of τ₀, (7,), N m.
        """
        gains = self.settings
        jacobian = model.jacobian
        # M⁻¹Jᵀ by the Cholesky factor of M, which is positive definite: the armature sees to that.
        _, solution, info = lapack.dposv(model.mass_matrix, jacobian.T, lower=1)
        if info != 0:
            raise FloatingPointError("the mass matrix is not positive definite: the state is not finite")
        self._inverse_mass_jacobian = solution
        self.task_inertia = bounded_inverse(jacobian.dot(solution), gains.singularity_floor)
        posture_torque = -gains.null_stiffness * posture_error - gains.null_damping * v
        if brake is not None:
            posture_torque += brake
        task_acceleration = -gains.task_stiffness * error - gains.task_damping * model.twist - model.drift
        # (1) + (2) with one product: Jᵀ Λ (ẍ_cmd − J M⁻¹ τ₀) + τ₀, since Nᵀ = I − Jᵀ Λ J M⁻¹.
        wrench = self.task_inertia.dot(task_acceleration - posture_torque.dot(solution))
        return wrench.dot(jacobian) + posture_torque

    def null_space_torque(self, model: RobotModel, joint_torque: Array) -> Array:
        """Nᵀ τ₀ for the state of the last call of `torque`, (7,), N m."""
        wrench = self.task_inertia @ (joint_torque @ self._inverse_mass_jacobian)
        return joint_torque - wrench @ model.jacobian
