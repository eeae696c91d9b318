"""Measured states of a robot's joints."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm.arm import Array
from contact_reach_ros.errors import InputError

REST_SPEED = 0.05
"""Joint speed up to which an arm is at rest, rad/s: above the noise of velocities, below what a hand does."""
BLIND_AFTER = 0.075
"""Time without a usable joint state after which nothing is known of the arm, s.

Linux stops real-time threads for 50 ms in one piece, and the drive holds an arm that nobody commands from 20 ms on.
"""


class JointState(NamedTuple):
    """One state of the arm; joints in the arm's order."""

    stamp_ns: int
    """Time of the measurement on the robot's clock, ns."""
    q: Array
    """Positions (n,), rad."""
    v: Array
    """Velocities (n,), rad/s."""
    torque: Array | None
    """Torques (n,) that have acted since the last state, N m, NaN while unknown; None if the robot reports none."""


def check_rest(v: Array) -> None:
    """Raise `InputError` unless an arm with these joint velocities (n,), rad/s, is at rest, as a reset needs it."""
    speed = float(np.abs(v).max())
    if not speed <= REST_SPEED:
        raise InputError(f"the arm moves with {speed:.3f} rad/s; reset needs at most {REST_SPEED:g} rad/s: wait for it")


def check_fresh(age: float) -> None:
    """Raise `InputError` unless the last usable joint state is at most so old, s, that a reset may rely on it."""
    if not age <= BLIND_AFTER:
        raise InputError(
            f"the last usable joint state is {1e3 * age:.0f} ms old; reset needs one of the last "
            f"{1e3 * BLIND_AFTER:.0f} ms: look at the driver and the network"
        )


def checked_torque(torque: Array, n: int, topic: str = "effort_controller/commands") -> Array:
    """Return the torques (n,), N m, after checking them; `topic` is named if they are refused.

    Raises `InputError` if there are not n of them or one is not finite.
    """
    if torque.shape != (n,):
        raise InputError(f"{topic}: data has {torque.size} values; expected {n}")
    # A sum is finite exactly when no summand is NaN or infinite (opposite infinities make NaN).
    if not math.isfinite(sum(torque.tolist())):
        raise InputError(f"{topic}: data = {torque.tolist()}; expected finite torques")
    return torque
