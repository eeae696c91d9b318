"""The baseline without a planner: law (1) straight to the goal, with the null-space law at the arm's own posture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import Arm, link_frames
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.settings import ROTATION_BOUND, PlanningSettings


class ReactivePlanner:
    """Sets x_d as far towards the goal as γ allows, and Δq to zero: obstacles push redundant joints aside."""

    memory = None

    def __init__(self, arm: Arm, settings: PlanningSettings) -> None:
        self._arm, self._settings, self._number = arm, settings, 0

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """There is nothing to prepare."""

    def reset(self) -> None:
        """There is nothing to forget."""

    def reseed(self, seed: int) -> None:
        """There is no chance."""

    def plan(self, request: Request) -> Plan:
        """One reference, from where the arm will be at its speed when the plan takes effect."""
        settings, goal, scale = self._settings, request.goal, request.speed_scale
        self._number += 1
        ahead = request.q + request.v * 1e-9 * (request.effect_ns - request.state_ns)
        rotations, origins = link_frames(self._arm, ahead)
        position, rotation = origins[-1], rotations[-1]
        way = goal.position - position
        bound = scale * settings.translation_bound
        step = np.clip(way, -bound, bound)
        if goal.rotation is not None:
            turn = Rotation.from_matrix(goal.rotation @ rotation.T).as_rotvec()
            bound = scale * ROTATION_BOUND
            rotation = Rotation.from_rotvec(np.clip(turn, -bound, bound)).as_matrix() @ rotation
        return Plan(
            number=self._number,
            effect_ns=request.effect_ns,
            knot_duration_s=settings.knot_duration,
            positions=(position + step)[None],
            rotations=rotation[None],
            postures=ahead[None],
            predicted_q=np.array([ahead, ahead]),
            predicted_positions=np.array([position, position + step]),
            predicted_contact_forces=np.zeros((1, len(self._arm.contact_links))),
            cost=0.0,
            cost_terms={},
            steps=0,
            stop_reason="reactive",
            solve_s=0.0,
            speed_scale=scale,
        )
