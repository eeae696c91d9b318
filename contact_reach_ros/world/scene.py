"""Scenes: an arm, its target and the obstacles around it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.world.goal import HOLD, Goal
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.rigid import Environment


@dataclass(frozen=True)
class MismatchSettings(Settings):
    """Differences of the simulated robot and its surroundings from the models of controller, observer and planner."""

    inertia_set: str = setting("alternative", "inertial parameters of the simulated arm: one of its sets")
    payload: float = setting(0.5, "unknown mass at the flange", unit="kg", minimum=0.0, maximum=14.0)
    friction_scale: float = setting(3.0, "factor on both joint frictions", minimum=0.0, maximum=20.0)
    noise_scale: float = setting(
        2.0, "factor on the noise of the joint sensors; 0 for ideal ones", minimum=0.0, maximum=100.0
    )
    foam_variation: float = setting(
        0.3,
        "greatest share by which the simulated foam is stiffer or softer, drawn by the seed",
        minimum=0.0,
        maximum=0.9,
    )
    foam_factor: float = setting(
        1.0, "greatest factor by which it is stiffer or softer in addition, drawn by the seed", minimum=1.0, maximum=5.0
    )
    placement_error: float = setting(
        0.0,
        "greatest distance of each obstacle from where it is seen, drawn by the seed",
        unit="m",
        minimum=0.0,
        maximum=0.1,
    )


NO_MISMATCH = MismatchSettings("nominal", payload=0.0, friction_scale=1.0, noise_scale=1.0, foam_variation=0.0)
"""The simulated robot without a mismatch."""


@dataclass(frozen=True)
class Scene:
    """A concrete scene."""

    name: str
    """Name of the YAML file."""
    arm: Arm
    """Arm that is simulated, and that target and obstacles were placed for."""
    seed: int
    """Seed of target and obstacles."""
    start: Array
    """Joint angles, (n,), rad."""
    target: Array
    """Flange position to reach, (3,), m, base frame."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles; arrays with a row per sphere hold them one after the other."""
    mismatch: MismatchSettings = NO_MISMATCH
    """Differences of the simulation from the models."""
    foam_scale: float = 1.0
    """Factor on all stiffnesses of the obstacles in the simulation; unknown to the planner."""
    environment: Environment = ()
    """Rigid bodies, which the arm must not touch."""
    offsets: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(len(obstacles), 3) from where each obstacle is seen to where it is in the simulation, m; empty for none."""
    orientation: str = HOLD
    """Of the tip at the target: 'hold' for that of the start, or 'free'."""

    @property
    def goal(self) -> Goal:
        """The task of the scene: the tip is to be at the target."""
        return Goal(self.target, self.orientation)

    @property
    def true_obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles where they are in the simulation."""
        if not len(self.offsets):
            return self.obstacles
        pairs = zip(self.obstacles, self.offsets, strict=True)
        return tuple(replace(obstacle, rest=obstacle.rest + offset) for obstacle, offset in pairs)
