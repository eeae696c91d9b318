"""How much permitted contact costs: less and less where it keeps the arm from its goal.

The paper's constraint is contact ≤ ε; forces below are permitted, and a small weight keeps them low. With that weight
alone the arm would wait for ever where the next step costs more contact than it gains way: in front of foam that is a
little stiffer than the one the weight was chosen for, or a centimetre before a goal inside it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

LEAST_SPEED = 0.3
"""Mean speed of approach that contact may slow the arm down to, as a share of what γ permits."""

_LEAST_SHARE = 0.01
_THERE = 0.005
"""At a goal that is nearer than this, nothing holds the arm up, m."""


class Approach(NamedTuple):
    """How the arm gets on, when a plan takes effect. In single precision, as bags keep it."""

    distance: float
    """From flange to goal, m."""
    share: float
    """Of the weight of permitted contact, for the next plan."""

    @classmethod
    def begin(cls, distance: float) -> Approach:
        """A new goal."""
        return cls(float(np.float32(distance)), 1.0)

    def go_on(
        self, distance: float, elapsed: float, patience: float, least_speed: float, is_firm: bool = False
    ) -> Approach:
        """Some time later.

        The share falls by a factor e with every `patience` that the arm is behind, and comes back as it catches up, or
        with every `patience` in which contact is firm.

        Parameters
        ----------
        distance
            Now, m.
        elapsed
            Time since then, s.
        patience
            s; 0 keeps the share as it is.
        least_speed
            That the arm shall approach with at least, on average, m/s; 0 and infinity keep the share as it is.
        is_firm
            Whether contact is expected to be as strong as it may get for the arm's getting on.
        """
        share = self.share
        if patience > 0.0 and 0.0 < least_speed < math.inf and distance > _THERE:
            ahead = (self.distance - distance) / least_speed - elapsed
            if is_firm:
                ahead = max(ahead, elapsed)
            # The limits keep the exponential finite whatever happened in between.
            share = min(max(share * math.exp(min(max(ahead / patience, -10.0), 10.0)), _LEAST_SHARE), 1.0)
        return Approach(float(np.float32(distance)), float(np.float32(share)))
