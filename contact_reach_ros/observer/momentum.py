"""Generalised-momentum observer: the external torque without acceleration or force sensors."""

from __future__ import annotations

import math

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.observer.settings import COULOMB_SPEED, MomentumSettings
from contact_reach_ros.timing import GAP_PERIODS, NANOSECONDS, PAUSE

_IDENTITY = np.eye(6)

_IMPLAUSIBLE = 1e5
"""Implausible values, Nm and Nms: a hundred times what the strongest joint could do."""


class MomentumObserver:
    """Residual r with ṙ = K (τ_ext − r), discretised exactly for a torque that is constant over the step.

    With p = M q̇ and u = τ − τ_0 + Cᵀq̇ − g − τ_f the update is r ← a r + (1 − a)(Δp/Δt − u), a = exp(−K Δt). It has no
    integral that could drift, and it uses each step's own length. Where τ has passed a low-pass of the drive's, so does
    everything else: the residual is then that of the filtered external torque.

    Attributes
    ----------
    residual
        Estimated external torque, (n,), N m; always finite. It starts again from zero after a pause of more than 0.1 s,
        and while the acting torque is unknown.
    gaps
        Steps that were too long, or backwards in time, and froze the residual.
    refused
        States that were not finite, or so far from any real one that the residual would not be.
    known_for
        Seconds for which the acting torque has been known, zero while it is not: the time since the hand-over.
    posture
        Joint positions (n,) of the last state that was used, rad.
    updated_ns
        Stamp of the state that the residual is from, ns; None before the first.
    """

    def __init__(self, settings: MomentumSettings, model: RobotModel, period: float = 0.001) -> None:
        """`period`: nominal time between states, s; steps of more than three are gaps."""
        settings = settings.resolve(model.arm)
        self.settings = settings
        self.residual = np.zeros(model.arm.n)
        self.gaps = 0
        self.refused = 0
        self.known_for = 0.0
        self.updated_ns: int | None = None
        self._model = model
        self._viscous = np.array(settings.viscous_friction)
        self._coulomb = np.array(settings.coulomb_friction) if any(settings.coulomb_friction) else None
        self._offset = np.array(settings.torque_offset) if any(settings.torque_offset) else None
        self._rotors = None if settings.rotors_in_torque else model.pinocchio.armature.copy()
        self._max_gap_ns = GAP_PERIODS * round(period * NANOSECONDS)
        self._cutoff = 2.0 * math.pi * settings.torque_cutoff
        self._filtered: Array | None = None
        """Δp/Δt − u without the acting torque, behind the drive's low-pass; None before the first step, or without."""
        self._momentum: Array | None = None
        self.posture = np.zeros(model.arm.n)
        self._stamp_ns = 0

    def update(self, q: Array, v: Array, torque: Array | None, stamp_ns: int) -> Array:
        """Take one state and return the residual, (n,), N m.

        A state or torque that is not finite is refused: the residual stays, and the next state is compared with the
        last good one.

        Parameters
        ----------
        q, v
            Joint positions (n,) rad and velocities (n,) rad/s.
        torque
            Torque that acted on the links since the last state, (n,), N m; the settings define what it includes. None
            while it is unknown, for example with the brakes closed.
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
            if torque is None or (previous is not None and elapsed_ns > PAUSE * NANOSECONDS):
                # Somebody may have moved the arm, or changed what it carries: it is handed over again.
                self.gaps += torque is not None
                self.residual, self.known_for, self._filtered = np.zeros_like(self.residual), 0.0, None
            elif previous is not None and elapsed_ns != 0:
                self.gaps += 1
                # The torque has been known for the whole step; a clock that was set back adds nothing.
                self.known_for += max(elapsed_ns, 0) / NANOSECONDS
            return self.residual
        elapsed = elapsed_ns / NANOSECONDS
        input_torque = torque + v.dot(model.coriolis_matrix(q, v)) - self._viscous * v
        if self.settings.gravity_in_torque:
            input_torque -= model.gravity
        if self._coulomb is not None:
            input_torque -= self._coulomb * np.tanh(v / COULOMB_SPEED)
        if self._offset is not None:
            input_torque -= self._offset
        external, filtered = (momentum - previous) / elapsed - input_torque, None
        if self._cutoff:
            without = external + torque
            before = torque if self._filtered is None else self._filtered
            filtered = without + math.exp(-self._cutoff * elapsed) * (before - without)
            external = filtered - torque
        keep = math.exp(-self.settings.gain * elapsed)
        residual = keep * self.residual + (1.0 - keep) * external
        # One check of the result finds whatever is wrong in position, velocity or torque.
        if not _plausible(residual):
            self.refused += 1
            return self.residual
        self._anchor(q, momentum, stamp_ns)
        self._filtered = filtered
        self.known_for += elapsed
        self.residual, self.updated_ns = residual, stamp_ns
        return residual

    def _anchor(self, q: Array, momentum: Array, stamp_ns: int) -> None:
        """Make this the state that the next one is compared with."""
        self.posture, self._momentum, self._stamp_ns = q, momentum, stamp_ns

    def flange_wrench(self, damping: float = 0.05) -> Array:
        """External force (3,) N and moment (3,) Nm at the flange, base axes, that would explain the residual.

        A damped pseudo-inverse of Jᵀ for the last state; a contact elsewhere on the arm appears as its equivalent.
        """
        jacobian = self._model.jacobian_at(self.posture)
        damped = jacobian.dot(jacobian.T) + damping**2 * _IDENTITY
        return np.linalg.solve(damped, jacobian.dot(self.residual))


def _plausible(values: Array) -> bool:
    """Whether all values are finite, and far from where sums overflow or a lag would take seconds to forget them."""
    return sum(map(abs, values.tolist())) < _IMPLAUSIBLE
