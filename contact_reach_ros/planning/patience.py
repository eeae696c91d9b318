"""Patience with permitted contact: its weight falls while it keeps the arm from the goal.

The paper's constraint is contact ≤ ε; forces below are permitted, and a small weight keeps them low. With that weight
alone the arm would wait forever where the next step costs more in contact than it gains on the way: in front of foam
slightly stiffer than the foam that the weight was chosen for, or a centimetre before a goal inside it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

LEAST_SPEED = 0.3
"""Mean speed of approach down to which contact may slow the arm, as a share of what γ permits."""

_LEAST_SHARE = 0.01
_THERE = 0.005
"""Distance to the goal within which the arm counts as arrived, not as delayed, m."""


class Approach(NamedTuple):
    """Progress towards a goal when a plan takes effect."""

    distance: float
    """From flange to goal, m."""
    share: float
    """Share of the weight of permitted contact for the next plan."""

    @property
    def weight_factors(self) -> dict[str, float]:
        """Factors on the weights of the cost's terms for the next plan."""
        return {"contact": self.share}

    @classmethod
    def begin(cls, distance: float) -> Approach:
        """Progress at the moment of a new goal."""
        return cls(distance, 1.0)

    def updated(
        self, distance: float, elapsed: float, patience: float, least_speed: float, is_firm: bool = False
    ) -> Approach:
        """Progress after some more time.

        The share falls by a factor e for every `patience` that the arm is behind. It recovers as the arm catches up, or
        by the same factor for every `patience` during which contact is firm.

        Parameters
        ----------
        distance
            Present distance to the goal, m.
        elapsed
            Time since the last progress, s.
        patience
            Time constant, s; 0 keeps the share as it is.
        least_speed
            Mean speed of approach below which the arm is behind, m/s; 0 and infinity keep the share as it is.
        is_firm
            Whether the expected contact is stronger than permitted.
        """
        share = self.share
        if patience > 0.0 and 0.0 < least_speed < math.inf and distance > _THERE:
            ahead = (self.distance - distance) / least_speed - elapsed
            if is_firm:
                ahead = max(ahead, elapsed)
            # The limits keep the exponential finite, whatever happened in between.
            share = min(max(share * math.exp(min(max(ahead / patience, -10.0), 10.0)), _LEAST_SHARE), 1.0)
        return Approach(distance, share)
