"""The compliant stop: gravity, damping, and a hold that yields. It can only take energy out of the arm."""

from __future__ import annotations

import math

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.kernels import Constant, limit_torque, yielded

BRAKING_TIME = 0.1
"""Time in which a moving arm is braked, s."""
GIVING_TIME, GIVING_WAY = 0.5, 0.005
"""Until when after the stop the hold gives way, s, and how far the tip then moves at most, m: so far that what the arm
presses is let go, and no farther, as it may be a weight."""
_STALE = 0.02
"""Time after which a velocity is none any more if positions and velocities stay as they are to the last bit, s: damping
by it would drive the arm."""
_GIVING_CONSTANT = 0.04
"""Time constant with which its tension goes meanwhile, s."""
_CARRIED_CONSTANT = 0.06
"""The same of the tension with which the stop begins, s."""
_CARRIED_SHARE = 0.05
"""Stiffness of the springs that have that tension, as a share of the hold's."""
_HOLD_SHARE = 0.5
"""Natural frequency of arm and hold as a share of the damping's rate: critically damped."""

_JERK_SHARE = 0.3
"""Share of the jerk that a joint's own torque can produce that is relied upon to end its acceleration in time: the
other joints' torques change meanwhile and may work against it."""


class PassiveStop:
    """Torque of one stop after the other.

    Springs are anchored where the joints are. Above the yield torque of a joint the anchor follows, as in dry friction:
    what is lighter is held, and a hand that pushes harder moves the arm. Damping and stiffness are in proportion to the
    mass matrix, so that every motion of the arm is damped alike. No estimate of an external torque enters.
    """

    def __init__(self, arm: Arm, constants: Array) -> None:
        """Make one that has not begun, of the arm that is stopped and its `make_constants`."""
        self._constants = constants
        # Whether the tool is there or not, and heavier than it should be: the arm is no lighter than without.
        self._bare = None if arm.bare is None else RobotModel(arm.bare)
        self._most: Array = constants[Constant.HOLD]
        self._spread: Array | None = None
        """(n, 2), rad, from the joints to the anchors of the hold and of the carried tension; None before the first."""
        self._stiffness: Array = np.eye(arm.n)
        self._compliance: Array = np.eye(arm.n)
        self._q = self._v = np.zeros(arm.n)
        self._since = self._repeated = 0.0
        self._gives = True
        """Whether the hold still gives way."""
        self._from = np.zeros(3)
        """Where the tip was after the braking time, (3,), m."""

    def begin(self) -> None:
        """Anchor the hold anew, where the arm is at the next state."""
        self._spread, self._since, self._gives = None, 0.0, True

    def torque(self, model: RobotModel, q: Array, v: Array, previous: Array, period: float) -> Array:
        """The torque (n,), N m; NaN if it is not finite.

        Parameters
        ----------
        model
            Updated for this state.
        q, v
            Joint positions (n,) rad and velocities (n,) rad/s.
        previous, period
            The last torque sent (n,), N m, and the time since then, s.
        """
        is_repeated = np.array_equal(q, self._q) and np.array_equal(v, self._v)
        self._repeated, self._v = self._repeated + period if is_repeated else 0.0, v
        if self._repeated > _STALE:
            v = np.zeros(len(v))
        if self._bare is not None:
            self._bare.update_dynamics(q)
        mass_matrix = (self._bare or model).mass_matrix
        gravity = self._constants[Constant.GRAVITY_SHARE] * model.gravity
        tension = self._tension(model, mass_matrix, q, previous - gravity, period)
        braking = self._braking_share(v, mass_matrix) * self._constants[Constant.STOP_RATE] * v
        return limit_torque(self._constants, gravity + tension - mass_matrix @ braking, previous, period)

    def _braking_share(self, v: Array, mass_matrix: Array) -> float:
        """Share of the damping with which every joint's torque can follow its speed down at its greatest rate.

        Damping that the rate delays would drive the arm back. One share for all joints keeps the damping dissipative.
        """
        rate, speed = self._constants[Constant.STOP_RATE], np.abs(v)
        jerk = _JERK_SHARE * self._constants[Constant.TORQUE_RATE] / mass_matrix.diagonal()
        # No slower than where the share becomes 1.
        speed = np.maximum(speed, jerk / rate**2)
        return float((np.sqrt(2.0 * jerk * speed - (jerk / rate) ** 2) / (rate * speed)).min())

    def _tension(self, model: RobotModel, mass_matrix: Array, q: Array, carried: Array, period: float) -> Array:
        """Tension (n,) of the hold and of what was `carried` (n,) besides gravity when the stop began, N m."""
        most = self._most
        if self._spread is None:
            self._stiffen(mass_matrix)
            carried = yielded(carried, most, self._compliance) / _CARRIED_SHARE
            self._spread = np.column_stack([np.zeros(len(q)), self._compliance @ carried])
        else:
            self._spread -= (q - self._q)[:, None]
        self._q, self._since = q, self._since + period
        hold, carried = (self._stiffness @ self._spread).T
        if (np.abs(hold) > most).any():
            hold = yielded(hold, most, self._compliance)
            # Where the arm is moved to it may be lighter.
            self._stiffen(mass_matrix)
            self._spread[:, 0] = self._compliance @ hold
        carried = _CARRIED_SHARE * carried
        if (np.abs(carried) > most).any():
            # A joint cannot be so far from where the stop began, unless its encoder was set anew.
            carried = yielded(carried, most, self._compliance)
            self._spread[:, 1] = self._compliance @ carried / _CARRIED_SHARE
        if self._since <= BRAKING_TIME:
            self._from = model.position.copy()
        elif self._since > GIVING_TIME or math.dist(model.position.tolist(), self._from.tolist()) > GIVING_WAY:
            self._gives = False
        constants = np.array([_GIVING_CONSTANT if self._gives else np.inf, _CARRIED_CONSTANT])
        self._spread *= 1.0 - np.minimum(period / constants, 1.0)
        return hold + carried

    def _stiffen(self, mass_matrix: Array) -> None:
        self._stiffness = (_HOLD_SHARE * self._constants[Constant.STOP_RATE, 0]) ** 2 * mass_matrix
        self._compliance = np.linalg.inv(self._stiffness).astype(float)
