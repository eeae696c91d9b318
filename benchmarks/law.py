"""The control laws (1)-(3) and (6) alone, as the paper has them: what the controller does without its limits."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.kinematics import POSE, TASK_ROWS
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control import kernels
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings


def pose_error(position: Array, rotation: Array, reference: Reference, task: str = POSE) -> Array:
    """Δx = x ⊖ x_d, (6,): translation in m, then the rotation vector of R R_dᵀ in rad, both in base axes.

    Where `task` is another, the rotation vector is that of what law (1) controls: of the turn of the tip's z axis, or
    zero.
    """
    return kernels.pose_error(position, rotation, reference.position, reference.rotation, TASK_ROWS[task])


class ImpedanceLaw:
    """Law (3) = (1) + (2) for one robot model, without the limits that the controller adds.

    Two additions to the paper's equations, both documented in docs/control.md: Λ is bounded near singularities, and
    the drift J̇q̇ is compensated in task space, without which the error dynamics Δẍ + Kd Δẋ + Kp Δx = 0 holds only
    for slow motion.
    """

    def __init__(self, arm: Arm, settings: ImpedanceSettings) -> None:
        self.settings = settings.resolve(arm)
        self._constants = make_constants(arm, settings)

    def torque(self, model: RobotModel, v: Array, posture_error: Array, error: Array) -> Array:
        """τ of law (3) without the C + g of law (1), (n,), N m.

        Raises `FloatingPointError` if the mass matrix is not positive definite.

        Parameters
        ----------
        model
            Model, updated to the present state.
        v
            Joint velocities, (n,), rad/s.
        posture_error
            Δq = q − q_d, (n,), rad.
        error
            Δx, (6,), from `pose_error` for the task of the settings.
        """
        factor, regular = kernels.factorise(model.mass_matrix, 0.0)
        if not regular:
            raise FloatingPointError("the mass matrix is not positive definite: the state is not finite")
        vectors = np.column_stack([model.jacobian, model.twist, model.drift, error])
        rows = kernels.controlled(vectors, model.rotation, self.settings.rows)
        driving, braking, rest = kernels.law_torques(
            self._constants, factor, rows[:, :-3], rows[:, -3], rows[:, -2], rows[:, -1], posture_error, v
        )
        return driving + braking + rest
