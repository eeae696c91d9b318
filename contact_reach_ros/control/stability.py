"""Which gains are stable at a rate, if a torque acts a period and the drive's delay after the state that it answers."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import SettingsError

DAMPED_SHARE = 0.4
"""Share of a joint's speed that its own damping may take in one period; with that of the others it is up to 0.8."""

_POSTURES = 200


class Lightness(NamedTuple):
    """How light the arm is in its lightest postures."""

    least_inertia: float
    """Smallest eigenvalue of M, kg m²."""
    mobility: Array
    """Largest (M⁻¹)_ii of each joint, (n,), 1/(kg m²)."""


@functools.cache
def lightness(arm: Arm) -> Lightness:
    """How light the arm is, among its home posture and 200 random ones."""
    model, random = RobotModel(arm), np.random.default_rng(0)
    postures = [np.array(arm.home), *random.uniform(arm.lower, arm.upper, (_POSTURES, arm.n))]
    least, mobility = np.inf, np.zeros(arm.n)
    for q in postures:
        model.update(q, np.zeros(arm.n))
        least = min(least, float(np.linalg.eigvalsh(model.mass_matrix)[0]))
        mobility = np.maximum(mobility, np.linalg.inv(model.mass_matrix).diagonal())
    return Lightness(least, mobility)


def spectral_radius(stiffness: float, damping: float, period: float, delay: float = 0.0) -> float:
    """Largest eigenvalue, in magnitude, of a unit mass on spring and damper whose force acts late.

    Parameters
    ----------
    stiffness, damping
        1/s² and 1/s.
    period
        Time between states, s.
    delay
        Of the force, s, beyond one period.
    """
    late, part = divmod(delay / period + 1e-9, 1.0)
    # Position, speed, and the forces that answer the states before, newest first: two of them act in one period.
    step = np.eye(4 + int(late), k=-1)
    step[:3] = 0.0
    step[:2, :2] = [[1.0, period], [0.0, 1.0]]
    step[0, -2:] = 0.5 * period**2 * (1.0 - part) ** 2, 0.5 * period**2 * (1.0 - (1.0 - part) ** 2)
    step[1, -2:] = period * (1.0 - part), period * part
    step[2, :2] = -stiffness, -damping
    return float(np.abs(np.linalg.eigvals(step)).max())


def check_gains(arm: Arm, gains: ImpedanceSettings, period: float, delay: float = 0.0) -> None:
    """Refuse gains that are not stable where torques act one period late, and the delay of the drive, s.

    Raises
    ------
    SettingsError
        Naming stiffness and damping of the law (1) or (2), and the largest in the same proportion that are stable.
    """
    inertia = lightness(arm).least_inertia
    for law, stiffness, damping, mass in (
        ("task", gains.task_stiffness, gains.task_damping, 1.0),
        ("null", gains.null_stiffness, gains.null_damping, inertia),
    ):
        if stiffness == damping == 0.0 or spectral_radius(stiffness / mass, damping / mass, period, delay) < 1.0:
            continue
        share, elastic, viscous = 1.0, stiffness / mass, damping / mass
        while share > 0.01 and spectral_radius(share**2 * elastic, share * viscous, period, delay) >= 1.0:
            share -= 0.005
        # So much less that it stays stable when it is rounded.
        share *= 0.99
        raise SettingsError(
            f"impedance.{law}_stiffness = {stiffness:g} and {law}_damping = {damping:g} are not stable at "
            f"{1.0 / period:g} Hz with {1e3 * (period + delay):g} ms of delay; expected at most "
            f"{share**2 * stiffness:.3g} and {share * damping:.3g} in this proportion, or a higher rate"
        )


def stable_damping(damping: Array, mobility: Array, period: float) -> Array:
    """The damping (n,) of joints, N m s/rad, no larger than is stable with a delay of one `period`, s.

    `mobility`: (M⁻¹)_ii of each joint, (n,), 1/(kg m²).
    """
    return np.minimum(damping, DAMPED_SHARE / (period * mobility))
