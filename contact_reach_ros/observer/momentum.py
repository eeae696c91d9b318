"""Generalised-momentum observer: the external torque without acceleration or force sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from contact_reach_ros.errors import InputError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_IDENTITY = np.eye(6)

_IMPLAUSIBLE = 1e5
"""Nm and Nms: a hundred times what the strongest joint could do."""


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
    coulomb_friction: tuple[float, ...] = setting(
        (0.0,) * iiwa14.N_JOINTS, "dry friction that the model expects", unit="Nm", minimum=0.0, maximum=50.0
    )
    coulomb_speed: float = setting(
        0.02,
        "speed at which the expected dry friction has reached 76 %, so that it does not jump with the sign",
        unit="rad/s",
        minimum=1e-4,
        maximum=1.0,
    )
    gravity_in_torque: bool = setting(
        True,
        "the acting torque carries the arm's weight; false for an arm that compensates gravity itself and reports, or "
        "is commanded, only what comes on top",
    )
    rotors_in_torque: bool = setting(
        True, "the acting torque also accelerates the rotors; false for torque sensors on the links' side of the gears"
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
        Estimated external torque, (7,), N m; always finite.
    gaps
        Steps that were too long, or backwards in time, and froze the residual.
    refused
        States that were not finite, or so far from any real one that the residual would not be.
    known_for
        Seconds for which the acting torque has been known, zero while it is not: how long ago the arm was handed over.
    """

    def __init__(self, settings: MomentumSettings, model: RobotModel) -> None:
        self.settings = settings
        self.residual = np.zeros(iiwa14.N_JOINTS)
        self.gaps = 0
        self.refused = 0
        self.known_for = 0.0
        self._model = model
        self._viscous = np.array(settings.viscous_friction)
        self._coulomb = np.array(settings.coulomb_friction) if any(settings.coulomb_friction) else None
        self._rotors = None if settings.rotors_in_torque else model.pinocchio.armature.copy()
        self._max_gap_ns = int(settings.max_gap * NANOSECONDS)
        self._momentum: Array | None = None
        self._q = np.zeros(iiwa14.N_JOINTS)
        self._stamp_ns = 0

    def reset(self) -> None:
        """Forget the residual and the last state."""
        self.residual = np.zeros(iiwa14.N_JOINTS)
        self.known_for = 0.0
        self._momentum = None

    def update(self, q: Array, v: Array, torque: Array | None, stamp_ns: int) -> Array:
        """Take one state and return the residual, (7,), N m.

        A state or torque that is not finite is refused: the residual stays, and the next state is compared with the
        last good one.

        Parameters
        ----------
        q, v
            Joint positions (7,) rad and velocities (7,) rad/s.
        torque
            Torque that acted on the links since the last state, (7,), N m; what it holds besides is said by the
            settings. None while it is unknown, for example with the brakes closed: the residual is kept.
        stamp_ns
            Time of the state.
        """
        model = self._model
        model.update_dynamics(q)
        momentum = model.mass_matrix.dot(v)
        if self._rotors is not None:
            momentum -= self._rotors * v
        previous, elapsed_ns = self._momentum, stamp_ns - self._stamp_ns
        if torque is None or previous is None or not 0 < elapsed_ns <= self._max_gap_ns:
            if not _plausible(momentum):
                self.refused += 1
                return self.residual
            self._anchor(q, momentum, stamp_ns)
            if torque is None:
                self.known_for = 0.0
            elif previous is not None and elapsed_ns != 0:
                self.gaps += 1
                # As long as it was, the torque has been known; a clock that was set back adds nothing.
                self.known_for += max(elapsed_ns, 0) / NANOSECONDS
            return self.residual
        elapsed = elapsed_ns / NANOSECONDS
        input_torque = torque + v.dot(model.coriolis_matrix(q, v)) - self._viscous * v
        if self.settings.gravity_in_torque:
            input_torque -= model.gravity
        if self._coulomb is not None:
            input_torque -= self._coulomb * np.tanh(v / self.settings.coulomb_speed)
        keep = math.exp(-self.settings.gain * elapsed)
        residual = keep * self.residual + (1.0 - keep) * ((momentum - previous) / elapsed - input_torque)
        # One look at the result finds whatever is wrong in position, velocity or torque.
        if not _plausible(residual):
            self.refused += 1
            return self.residual
        self._anchor(q, momentum, stamp_ns)
        self.known_for += elapsed
        self.residual = residual
        return residual

    def _anchor(self, q: Array, momentum: Array, stamp_ns: int) -> None:
        """Compare the next state with this one."""
        self._q, self._momentum, self._stamp_ns = q, momentum, stamp_ns

    def flange_wrench(self, damping: float = 0.05) -> Array:
        """External force (3,) N and moment (3,) Nm at the flange, base axes, that would explain the residual.

        A damped pseudo-inverse of Jᵀ for the last state; a contact elsewhere on the arm appears as its equivalent.
        """
        jacobian = self._model.jacobian_at(self._q)
        damped = jacobian.dot(jacobian.T) + damping**2 * _IDENTITY
        _, wrench, _ = lapack.dposv(damped, jacobian.dot(self.residual))
        return wrench


def measured_torque(effort: Array | None) -> Array | None:
    """The acting torque that joint states report, (7,), N m; None while it is unknown, as with the brakes closed.

    Raises
    ------
    InputError
        If the message had no efforts, or some that are not finite.
    """
    if effort is None:
        raise InputError("joint_states: effort is empty; let the driver fill it, or set torque_source to commanded")
    if np.isfinite(effort.sum()):
        return effort
    if np.isnan(effort).all():
        return None
    raise InputError(f"joint_states: effort = {effort.tolist()}; expected finite torques, or all NaN while unknown")


def _plausible(values: Array) -> bool:
    """Whether all are finite and far from where sums overflow or a lag would take seconds to forget them."""
    return sum(map(abs, values.tolist())) < _IMPLAUSIBLE
