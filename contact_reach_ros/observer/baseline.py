"""The baseline of the external torque: what a wrong model causes, within what the arm's posture explains."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.timing import states_in

GRAVITY_SHARE = 0.1
"""Error of a joint's modelled gravity, as a share of its change with the posture."""
PAYLOAD, OFF_CENTER = 0.5, 0.05
"""Mass at the tip that nobody has declared, kg, and how far from it, m: off the axis it acts on the last joint."""
CONTACT_SHARE = 0.1
"""Share of what motion explains that is taken in contact: little of the contact, but enough for one to end for an arm
that meanwhile moves to where the model's error is another one."""
HANDOVER_MEAN = 10
"""Time constant with which the baseline follows while the arm is handed over, ms."""

_STEP = 0.01
"""Distance between two postures from which on the arm has moved, rad: far above the noise of encoders."""


class Baseline:
    """The part of the external torque that an error of the model explains.

    An error of the model changes only with the posture. So the baseline stays while the arm is at rest. While it moves,
    the baseline of each joint approaches the external torque by at most what the motion explains: a share of the change
    of modelled gravity, and the change of the torque of an unknown payload. Motion to and fro explains nothing: the
    baseline differs from its anchor, where the arm was handed over or reset, by at most what the difference of the
    postures explains. Whatever the external torque does beyond that is contact, however slowly it grows.

    Attributes
    ----------
    mean
        The baseline (n,), N m.
    anchor
        Its value where the arm was handed over or reset, (n,), N m.
    """

    def __init__(self, model: RobotModel, limits: Sequence[float], period: float) -> None:
        """Make a baseline of zero.

        Parameters
        ----------
        model
            Of the arm; its attributes change.
        limits
            Greatest value at the anchor (n,), N m.
        period
            Nominal time between states, s.
        """
        self._model = model
        x, y, z = self._weight = PAYLOAD * np.array(model.arm.gravity)
        self._moment = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        """c ↦ c × weight."""
        self._limits = np.array(limits)
        self._hand_over = 1.0 / states_in(HANDOVER_MEAN, period)
        self._q: list[float] = []
        """Where the arm was at the last step; empty before the first torque."""
        self.anchor = np.zeros(model.arm.n)
        self._weights = self._anchor_weights = self._weights_at(np.zeros(model.arm.n))
        self.mean = [0.0] * model.arm.n

    def restart(self, torque: Array, q: Array) -> None:
        """Anchor it here: attribute the torque (n,), N m, at posture `q` (n,), rad, to the model within the limits."""
        self.anchor = np.clip(torque, -self._limits, self._limits)
        self._weights = self._anchor_weights = self._weights_at(q)
        self._q, self.mean = q.tolist(), self.anchor.tolist()

    def hand_over(self, torque: Array, q: Array) -> None:
        """Follow the external torque (n,), N m, while nothing moves yet, and anchor the baseline here."""
        mean = np.array(self.mean)
        self.restart(mean + self._hand_over * (torque - mean), q)

    def follow(self, torque: Array, q: Array, in_contact: bool) -> None:
        """Follow the external torque (n,), N m, to posture `q` (n,), rad, as far as the motion explains it.

        Torques that are not finite are ignored.
        """
        position = q.tolist()
        if not self._q:
            self.restart(np.array(self.mean), q)
        elif math.dist(position, self._q) > _STEP and math.isfinite(torque.sum()):
            weights = self._weights_at(q)
            step = (CONTACT_SHARE if in_contact else 1.0) * _explained(self._weights, weights)
            reach = _explained(self._anchor_weights, weights)
            mean = np.clip(torque, self.mean - step, self.mean + step)
            self.mean = np.clip(mean, self.anchor - reach, self.anchor + reach).tolist()
            self._q, self._weights = position, weights

    def _weights_at(self, q: Array) -> _Weights:
        model = self._model
        model.update_dynamics(q)
        jacobian = model.jacobian_at(q)
        off_center = jacobian[3:].T @ self._moment @ model.data.oMf[model.tip].rotation
        return model.gravity.copy(), jacobian[:3].T @ self._weight, off_center


_Weights = tuple[Array, Array, Array]
"""Modelled gravity (n,), the torque (n,) of a payload at the tip, N m, and its change per offset (n, 3), N."""


def _explained(before: _Weights, now: _Weights) -> Array:
    """The most that a wrong model's error changes between two postures, (n,), N m."""
    gravity, payload, off_center = (np.abs(new - old) for old, new in zip(before, now, strict=True))
    return GRAVITY_SHARE * gravity + payload + OFF_CENTER * np.sqrt(np.square(off_center).sum(axis=1))
