"""Generalised-momentum observer: the external torque without acceleration or force sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_IDENTITY = np.eye(6)


@dataclass(frozen=True)
class MomentumSettings(Settings):
    """Settings of the momentum observer."""

    gain: float = setting(
        50.0,
        "K: the residual follows the external torque as a first-order lag of 1/K",
        unit="1/s",
        minimum=1.0,
        maximum=500.0,
    )
    viscous_friction: tuple[float, ...] = setting(
        (0.0,) * iiwa14.N_JOINTS,
        "friction per speed that the model expects",
        unit="Nm s/rad",
        minimum=0.0,
        maximum=50.0,
    )
    max_gap: float = setting(
        0.003, "longer steps between states freeze the residual and start afresh", unit="s", minimum=0.001, maximum=0.1
    )


class MomentumObserver:
    """Residual r with ṙ = K (τ_ext − r), discretised exactly for a torque that is constant over the step.

    With p = M q̇ and u = τ + Cᵀq̇ − g − τ_f the update is r ← a r + (1 − a)(Δp/Δt − u), a = exp(−K Δt). It has no
    integral that could drift and takes each step's own length.

    Attributes
    ----------
    residual
        Estimated external torque, (7,), N m.
    gaps
        Steps that were too long and froze the residual.
    """

    def __init__(self, settings: MomentumSettings, model: RobotModel) -> None:
        self.settings = settings
        self.residual = np.zeros(iiwa14.N_JOINTS)
        self.gaps = 0
        self._model = model
        self._friction = np.array(settings.viscous_friction)
        self._max_gap_ns = int(settings.max_gap * NANOSECONDS)
        self._momentum: Array | None = None
        self._q = np.zeros(iiwa14.N_JOINTS)
        self._stamp_ns = 0

    def reset(self) -> None:
        """Forget the residual and the last state."""
        self.residual = np.zeros(iiwa14.N_JOINTS)
        self._momentum = None

    def update(self, q: Array, v: Array, torque: Array | None, stamp_ns: int) -> Array:
        """Take one state and return the residual, (7,), N m.

        Parameters
        ----------
        q, v
            Joint positions (7,) rad and velocities (7,) rad/s.
        torque
            Torque that acted on the links since the last state, (7,), N m, gravity compensation included; None while
            it is unknown, for example with the brakes closed: the residual is kept.
        stamp_ns
            Time of the state.
        """
        model = self._model
        model.update_dynamics(q)
        momentum = model.mass_matrix.dot(v)
        self._q = q
        elapsed_ns = stamp_ns - self._stamp_ns
        previous, self._momentum, self._stamp_ns = self._momentum, momentum, stamp_ns
        if torque is None or previous is None or elapsed_ns <= 0:
            return self.residual
        if elapsed_ns > self._max_gap_ns:
            self.gaps += 1
            return self.residual
        elapsed = elapsed_ns / NANOSECONDS
        input_torque = torque + v.dot(model.coriolis_matrix(q, v)) - model.gravity - self._friction * v
        keep = math.exp(-self.settings.gain * elapsed)
        self.residual = keep * self.residual + (1.0 - keep) * ((momentum - previous) / elapsed - input_torque)
        return self.residual

    def flange_wrench(self, damping: float = 0.05) -> Array:
        """External force (3,) N and moment (3,) Nm at the flange, base axes, that would explain the residual.

        A damped pseudo-inverse of Jᵀ for the last state; a contact elsewhere on the arm appears as its equivalent.
        """
        jacobian = self._model.jacobian_at(self._q)
        damped = jacobian.dot(jacobian.T) + damping**2 * _IDENTITY
        _, wrench, _ = lapack.dposv(damped, jacobian.dot(self.residual))
        return wrench
