"""A planner that leads the arm along its free path, whatever stands in the way: no compilation, no chance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import SceneError
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.scenes.placing import free_path
from contact_reach_ros.world.scene import Scene

_KNOTS = 3
_KNOT_S = 0.1
_STEPS = 4
"""Steps of the free path in one knot."""


class ScriptedPlanner:
    """Follows the free path to the scene's target from where the arm is, and takes its time at the end.

    Raises
    ------
    SceneError
        If the scene has no free path.
    """

    memory = None

    def __init__(self, scene: Scene) -> None:
        self.model = RobotModel(scene.arm)
        try:
            self.path = free_path(self.model, scene.start, scene.target)
        except SceneError as error:
            raise SceneError(f"scene {scene.name}, seed {scene.seed}: no free path to follow, as {error}") from error
        poses = [self.model.tip_pose(q) for q in self.path]
        self.positions = np.array([position for position, _ in poses])
        self.rotations = np.array([rotation for _, rotation in poses])
        self.number = 0

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """There is nothing to prepare."""

    def reset(self) -> None:
        """Count plans from 1 again."""
        self.number = 0

    def reseed(self, seed: int) -> None:
        """There is no chance."""
        self.reset()

    def plan(self, request: Request) -> Plan:
        """The next part of the path, from where the arm will be when the plan takes effect."""
        self.number += 1
        tip: Array = self.model.tip_pose(request.q)[0]
        nearest = int(np.linalg.norm(self.positions - tip, axis=1).argmin())
        knots = np.minimum(nearest + 2 + _STEPS * np.arange(1, _KNOTS + 1), len(self.path) - 1)
        return Plan(
            number=self.number,
            effect_ns=request.effect_ns,
            knot_duration_s=_KNOT_S,
            positions=self.positions[knots],
            rotations=self.rotations[knots],
            postures=self.path[knots],
            predicted_q=self.path[[nearest, *knots]],
            predicted_positions=self.positions[[nearest, *knots]],
            predicted_contact_forces=np.zeros((_KNOTS, len(self.model.arm.contact_links))),
            cost=0.0,
            cost_terms={},
            steps=0,
            stop_reason="scripted",
            solve_s=0.0,
        )
