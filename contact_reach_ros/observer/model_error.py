"""What of the external torque is attributed to the model: a slow mean that changes only as the posture does."""

from __future__ import annotations

import math
from collections.abc import Sequence

_STEP = 0.01
"""Distance between two postures from which on the arm has moved, rad: far above the noise of encoders."""

_JUMP = 0.2
"""Distance between the postures of two states that no arm covers, rad: an encoder jumped."""


class ModelError:
    """Slow mean of the external torque, within what an error of the model explains.

    Wrong weights cause a torque that follows from the posture alone: it is bounded, and so is its change per radian.
    At rest only friction changes it. Whatever the external torque does beyond that is a contact, however slowly it
    grows.

    Attributes
    ----------
    mean
        The slow mean, (n,), N m.
    """

    def __init__(self, bounds: Sequence[float], per_rad: Sequence[float], at_rest: Sequence[float]) -> None:
        """Per joint (n,): greatest mean, N m, its greatest change per distance, N m/rad, and at rest, N m."""
        self._bounds, self._per_rad, self._at_rest = bounds, per_rad, at_rest
        self._posture: list[float] = []
        """Where the arm was when it last counted as moved; empty before the first torque."""
        self._anchor: list[float] = []
        """What the mean may differ from by no more than at rest."""
        self._ranges: list[tuple[float, float]] = []
        self.mean = [0.0] * len(bounds)

    def restart(self, mean: list[float], q: list[float]) -> None:
        """Attribute torques (n,), N m, to the model at posture `q` (n,), rad, as far as the bounds permit."""
        self._posture = q
        self._set_anchor(mean)
        self.mean = self._clipped(mean)

    def follow(self, torques: list[float], q: list[float], states: int, freely: bool = False) -> None:
        """Follow the external torques (n,), N m, at posture `q` (n,), rad, with a lag of so many states.

        With `freely` they may change at rest, too. Torques that are not finite are ignored.
        """
        share = 1.0 / states
        mean = [slow + share * (torque - slow) for torque, slow in zip(torques, self.mean, strict=True)]
        if not math.isfinite(sum(mean)):
            return
        if freely or not self._posture:
            self.restart(mean, q)
            return
        distance = math.dist(q, self._posture)
        if distance > _STEP:
            if distance < _JUMP:
                self._move(mean, distance)
            self._posture = q
        self.mean = self._clipped(mean)

    def _move(self, mean: list[float], distance: float) -> None:
        limits = [slope * distance for slope in self._per_rad]
        joints = zip(mean, self._anchor, limits, strict=True)
        self._set_anchor([anchor + min(max(slow - anchor, -limit), limit) for slow, anchor, limit in joints])

    def _set_anchor(self, anchors: list[float]) -> None:
        self._anchor = [min(max(anchor, -bound), bound) for anchor, bound in zip(anchors, self._bounds, strict=True)]
        joints = zip(self._anchor, self._at_rest, self._bounds, strict=True)
        self._ranges = [(max(anchor - band, -bound), min(anchor + band, bound)) for anchor, band, bound in joints]

    def _clipped(self, mean: list[float]) -> list[float]:
        # For so few numbers comparisons of plain floats are faster than min and max, and those than NumPy.
        return [
            low if slow < low else high if slow > high else slow
            for slow, (low, high) in zip(mean, self._ranges, strict=True)
        ]
