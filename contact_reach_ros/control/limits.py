"""What keeps torques and joints within their limits, whatever the laws ask for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.robot import iiwa14

Array = NDArray[np.float64]

_WATCHED_SHARE = 0.5
"""Joints slower than this share of the speed that they may have are far from being driven beyond it."""


class JointLimitRepulsion:
    """Pushes joints out of a margin before their position limits.

    The torque grows with the square of the depth, so that it starts without a step, and reaches the given share of
    the joint's torque limit at the position limit. Damping acts on motion towards the limit and grows alike.
    """

    def __init__(self, settings: LimitSettings) -> None:
        self._margin = settings.joint_limit_margin
        self._threshold = np.array(iiwa14.POSITION_LIMITS) - self._margin
        limits = np.array(iiwa14.TORQUE_LIMITS)
        self._threshold_list = self._threshold.tolist()
        self._strength = settings.joint_limit_torque_share * limits
        self._damping = settings.joint_limit_damping * limits / limits.max()

    def torque(self, q: Array, v: Array) -> Array | None:
        """Torque (7,) in N m for positions (7,) rad and velocities (7,) rad/s; None when no joint is near a limit."""
        # For seven numbers a loop is faster than NumPy.
        for angle, threshold in zip(q.tolist(), self._threshold_list, strict=True):
            if not -threshold <= angle <= threshold:
                break
        else:
            return None
        depth = np.clip((np.abs(q) - self._threshold) / self._margin, 0.0, 1.5)
        side = np.sign(q)
        approach = np.maximum(side * v, 0.0)
        return -side * (self._strength * depth * depth + self._damping * depth * approach)


class SpeedLimiter:
    """Keeps joints below a share of their speed limits: by the null space as long as that does, else whatever the task.

    What posture references set in motion in the null space has little damping of its own. From a first share of its
    limit on a joint's speed is braked there, τ₀ = −M k e with e the speeds beyond, which the task does not feel.

    A second share v_max is not passed, however strong the torques τ are: the acceleration q̈ = M⁻¹ τ of a joint in the
    direction in which it moves may be no greater than k (v_max − |v|), and what is beyond is taken away by −M e, with e
    the excess accelerations, which leaves those of the other joints alone.
    """

    def __init__(self, settings: LimitSettings) -> None:
        limits = np.array(iiwa14.VELOCITY_LIMITS)
        self._ceiling = settings.velocity_limit_share * limits
        self._braked = settings.null_velocity_share * limits
        self._watched = np.minimum(self._braked, _WATCHED_SHARE * self._ceiling)
        self._watched_list = self._watched.tolist()
        self._rate = settings.velocity_limit_rate

    def null_torque(self, v: Array, mass_matrix: Array) -> Array | None:
        """τ₀ (7,) in N m for speeds (7,) rad/s and M (7, 7), to be projected; None when no joint is fast."""
        # For seven numbers a loop is faster than NumPy.
        for speed, watched in zip(v.tolist(), self._watched_list, strict=True):
            if not -watched <= speed <= watched:
                break
        else:
            return None
        beyond = np.sign(v) * np.maximum(np.abs(v) - self._braked, 0.0)
        return -self._rate * mass_matrix.dot(beyond)

    def torque(self, v: Array, mass_matrix: Array, torque: Array) -> Array | None:
        """What to add (7,), N m; None when nothing is to be added.

        To be asked only where `null_torque` found a fast joint.

        Parameters
        ----------
        v
            Joint speeds (7,), rad/s.
        mass_matrix
            M, (7, 7), positive definite.
        torque
            All that drives the arm (7,), N m, without what only compensates C + g.
        """
        _, acceleration, _ = lapack.dposv(mass_matrix, torque)
        speeds, sides = np.abs(v), np.sign(v)
        excess = np.maximum(sides * acceleration - self._rate * (self._ceiling - speeds), 0.0)
        excess[speeds <= self._watched] = 0.0
        return -mass_matrix.dot(sides * excess) if excess.any() else None


class TorqueLimiter:
    """Caps each torque and the rate at which it changes; the cap wins."""

    def __init__(self, settings: LimitSettings) -> None:
        self._cap = settings.torque_share * np.array(iiwa14.TORQUE_LIMITS)
        self._least = -self._cap
        self._rate = torque_rates(settings)
        self._previous = np.zeros(iiwa14.N_JOINTS)

    def start(self, torque: Array) -> None:
        """Take a torque (7,) in N m, the one that holds the arm, as the last one sent."""
        self._previous = np.minimum(np.maximum(torque, self._least), self._cap)

    def limit(self, torque: Array, period: float) -> Array:
        """The torque (7,) in N m that may follow the last one after `period` seconds."""
        step = self._rate * period
        limited = np.minimum(np.maximum(torque, self._previous - step), self._previous + step)
        limited = np.minimum(np.maximum(limited, self._least), self._cap)
        self._previous = limited
        return limited


def torque_rates(settings: LimitSettings) -> Array:
    """Greatest change of each joint's torque (7,), N m/s: in proportion to the joints' torque limits."""
    limits = np.array(iiwa14.TORQUE_LIMITS)
    return settings.torque_rate * limits / limits.max()
