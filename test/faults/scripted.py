"""A planner that leads the arm along its free path, whatever stands in the way: no compilation, no chance."""

from __future__ import annotations

import numpy as np
from plans import make_plan

from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.free_path import free_path

_KNOTS = 3
_KNOT_S = 0.1
_STEPS = 4
"""Steps of the free path in one knot."""


class ScriptedPlanner:
    """Follows the free path from where the arm is, and takes its time at the end."""

    def __init__(self, scene) -> None:
        self.model = RobotModel()
        self.path = free_path(self.model, scene.start, scene.target)
        poses = [self.model.flange_pose(q) for q in self.path]
        self.positions = np.array([position for position, _ in poses])
        self.rotations = np.array([rotation for _, rotation in poses])
        self.number = 0

    def warm_up(self, progress) -> None:
        pass

    def reset(self) -> None:
        self.number = 0

    def reseed(self, seed) -> None:
        pass

    def plan(self, q, v, now_ns, effect_ns, goal, spheres):
        self.number += 1
        nearest = int(np.linalg.norm(self.positions - self.model.flange_pose(q)[0], axis=1).argmin())
        # From where the arm will be when the plan takes effect.
        knots = np.minimum(nearest + 2 + _STEPS * np.arange(1, _KNOTS + 1), len(self.path) - 1)
        return make_plan(
            self.positions[knots],
            self.rotations[knots],
            self.path[knots],
            number=self.number,
            effect_ns=effect_ns,
            knot_duration_s=_KNOT_S,
        )
