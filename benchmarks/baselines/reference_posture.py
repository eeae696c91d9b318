"""Law (6), the paper's comparison for the null space: plans of Δx alone, and a steady pull to one posture."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.arm import Arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, ReferenceSpace
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.planning.transfer.pipeline import Pose, Reference


@dataclass(frozen=True, eq=False)
class PostureObjective(Objective):
    """Cost (5) where the same q_d is in force all the time."""

    posture: jax.Array
    """(n, 1) q_d of law (6), rad."""

    def latch(self, q: jax.Array, v: jax.Array, pose: Pose, action: jax.Array) -> Reference:
        """As for any plan, but with the posture of law (6)."""
        posture = jnp.broadcast_to(self.posture, (len(self.posture), action.shape[-1]))
        return super().latch(q, v, pose, action)._replace(posture=posture)


class PostureSpace(ReferenceSpace):
    """Decision variables: of each knot the rows of Δx that law (1) controls."""

    def __init__(self, arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> None:
        super().__init__(arm, settings, gains)
        closed, posture = self.objective, single(np.array(arm.default("reference_posture"))[:, None])
        self.objective = PostureObjective(closed.system, closed.horizon, closed.substeps, posture)
        rows = self.objective.system.gains.rows
        self._planned = self._planned[:rows]
        self.bounds, self.spread = (
            values.reshape(settings.horizon, -1)[:, :rows].ravel() for values in (self.bounds, self.spread)
        )


class PosturePlanner(RecedingHorizonPlanner):
    """Plans Δx; law (6) moves the redundant joints."""

    _make_space = PostureSpace
