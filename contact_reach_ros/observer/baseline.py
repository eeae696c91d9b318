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
FRICTION_SHARE = 0.1
"""Error of a joint's friction, as a share of the budget's `contact_thresholds`."""
MEAN_TIME = 300
"""Time constant with which the baseline follows, ms: a contact grows faster, postures change more slowly."""
CONTACT_MEMORY = 10
"""How many times as slowly it follows in contact: long enough for a contact, which would otherwise never end for an arm
that meanwhile moves to where the model's error is another one."""
HANDOVER_MEAN = 10
"""The same while the arm is handed over, ms."""

_STEP = 0.01
"""Distance between two postures from which on the arm has moved, rad: far above the noise of encoders."""


class Baseline:
    """Slow mean of the external torque, within what an error of the model explains.

    The range depends on the posture alone, and not on the way there: per joint, the value at the anchor, where the arm
    was handed over or reset, and on both sides of it a share of the change of modelled gravity since, the change of the
    torque of an unknown payload, and friction. Motion that changes neither widens nothing: whatever the external torque
    does beyond that is contact, however slowly it grows.

    Attributes
    ----------
    mean
        The baseline (n,), N m.
    anchor
        Its value where the arm was handed over or reset, (n,), N m.
    """

    def __init__(
        self, model: RobotModel, limits: Sequence[float], contact_thresholds: Sequence[float], period: float
    ) -> None:
        """Make a baseline of zero.

        Parameters
        ----------
        model
            Of the arm; its attributes change.
        limits
            Greatest value at the anchor (n,), N m.
        contact_thresholds
            Of the budget, (n,), N m.
        period
            Nominal time between states, s.
        """
        self._model = model
        x, y, z = self._weight = PAYLOAD * np.array(model.arm.gravity)
        self._moment = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        """c ↦ c × weight."""
        self._limits = np.array(limits)
        self._friction = FRICTION_SHARE * np.array(contact_thresholds)
        self._follow, self._hand_over = 1.0 / states_in(MEAN_TIME, period), 1.0 / states_in(HANDOVER_MEAN, period)
        self._q: list[float] = []
        """Where the arm was when the range was computed; empty before the first torque."""
        self.anchor = np.zeros(model.arm.n)
        self._gravity, self._payload, self._off_center = self._weights(np.zeros(model.arm.n))
        self._low = self._high = self.mean = [0.0] * model.arm.n

    def restart(self, torque: Array, q: Array) -> None:
        """Anchor it here: attribute the torque (n,), N m, at posture `q` (n,), rad, to the model within the limits."""
        self.anchor = np.clip(torque, -self._limits, self._limits)
        self._gravity, self._payload, self._off_center = self._weights(q)
        self._q, self.mean = q.tolist(), self.anchor.tolist()
        self._low, self._high = (self.anchor - self._friction).tolist(), (self.anchor + self._friction).tolist()

    def hand_over(self, torque: Array, q: Array) -> None:
        """Follow the external torque (n,), N m, while nothing moves yet, and anchor the baseline here."""
        mean = np.array(self.mean)
        self.restart(mean + self._hand_over * (torque - mean), q)

    def follow(self, torque: list[float], q: Array, in_contact: bool) -> None:
        """Follow the external torque (n,), N m, at posture `q` (n,), rad, more slowly in contact.

        Torques that are not finite are ignored.
        """
        if not math.isfinite(sum(torque)):
            return
        if not self._q:
            self.restart(np.array(self.mean), q)
        elif math.dist(q.tolist(), self._q) > _STEP:
            self._set_range(q)
        share = self._follow / CONTACT_MEMORY if in_contact else self._follow
        # For so few numbers comparisons of plain floats are faster than min and max, and those than NumPy.
        joints = zip(torque, self.mean, self._low, self._high, strict=True)
        followed = ((old + share * (now - old), low, high) for now, old, low, high in joints)
        self.mean = [low if slow < low else high if slow > high else slow for slow, low, high in followed]

    def _set_range(self, q: Array) -> None:
        gravity, payload, off_center = self._weights(q)
        width = GRAVITY_SHARE * np.abs(gravity - self._gravity) + np.abs(payload - self._payload) + self._friction
        width += OFF_CENTER * np.sqrt(np.square(off_center - self._off_center).sum(axis=1))
        self._q = q.tolist()
        self._low, self._high = (self.anchor - width).tolist(), (self.anchor + width).tolist()

    def _weights(self, q: Array) -> tuple[Array, Array, Array]:
        """Modelled gravity (n,), the torque (n,) of a payload at the tip, N m, and its change per offset (n, 3), N."""
        model = self._model
        model.update_dynamics(q)
        jacobian = model.jacobian_at(q)
        rotation = model.data.oMf[model.tip].rotation
        return model.gravity.copy(), jacobian[:3].T @ self._weight, jacobian[3:].T @ self._moment @ rotation
