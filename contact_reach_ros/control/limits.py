"""What keeps torques and joints within their limits, whatever the laws ask for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.robot import iiwa14

Array = NDArray[np.float64]


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
    """Brakes joints that come near their speed limit.

    A joint is decelerated in proportion to its speed beyond the given share of its limit, whatever its inertia, so that
    the brake is stable for any: τ = −M k e, with e the speeds beyond.
    """

    def __init__(self, settings: LimitSettings) -> None:
        self._permitted = settings.velocity_limit_share * np.array(iiwa14.VELOCITY_LIMITS)
        self._permitted_list = self._permitted.tolist()
        self._rate = settings.velocity_limit_rate

    def torque(self, v: Array, mass_matrix: Array) -> Array | None:
        """Torque (7,) in N m for speeds (7,) rad/s and M (7, 7); None when no joint is fast."""
        # For seven numbers a loop is faster than NumPy.
        for speed, permitted in zip(v.tolist(), self._permitted_list, strict=True):
            if not -permitted <= speed <= permitted:
                break
        else:
            return None
        beyond = np.sign(v) * np.maximum(np.abs(v) - self._permitted, 0.0)
        return -self._rate * mass_matrix.dot(beyond)


class TorqueLimiter:
    """Caps each torque and the rate at which it changes; the cap wins."""

    def __init__(self, settings: LimitSettings) -> None:
        self._cap = settings.torque_share * np.array(iiwa14.TORQUE_LIMITS)
        self._least = -self._cap
        self._rate = settings.torque_rate
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
