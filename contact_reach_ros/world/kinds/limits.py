"""Checks of settings that all kinds of obstacles share."""

from __future__ import annotations

from contact_reach_ros.errors import SceneError, SettingsError

_STEP = 0.001
"""Step of the simulation, s."""


def check_stiffness(kind: str, stiffness: float, mass: float) -> None:
    """Refuse springs and contact of `stiffness` N/m on `mass` kg that are unstable in a simulation in steps of 1 ms.

    Semi-implicit Euler steps are stable up to 4 m / dt²; half of that leaves room for hardening and mismatch. Raises
    `SceneError` if they are too stiff; the message gives the greatest stiffness.
    """
    limit = 2.0 * mass / _STEP**2
    if stiffness > limit:
        raise SceneError(
            f"{kind}: springs and contact of {stiffness:g} N/m in all on {mass:g} kg; the simulation in steps of "
            f"1 ms is stable up to {limit:g} N/m: use softer foam or more mass"
        )


def check_overlaps(kind: str, least: float, greatest: float) -> None:
    """Refuse limits, m, of the overlap with the free path that are in the wrong order.

    Raises `SettingsError` if they are; the message gives both.
    """
    if least > greatest:
        raise SettingsError(f"{kind}: min_overlap = {least:g}: expected at most max_overlap = {greatest:g} m")
