"""Scenes: an arm, its target and the obstacles around it, made concrete from YAML files by a seed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import SceneError, SettingsError
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.world.obstacle import Obstacle, ObstacleSettings
from contact_reach_ros.world.rigid import Environment


@dataclass(frozen=True)
class TargetSettings(Settings):
    """The box in which targets are drawn, and the start of episodes."""

    minimum: tuple[float, ...] = setting((0.2, -0.3, 0.0), "lower corner", unit="m", minimum=-1.5, maximum=1.5)
    maximum: tuple[float, ...] = setting((0.6, 0.3, 0.5), "upper corner", unit="m", minimum=-1.5, maximum=1.5)
    min_distance: float = setting(0.2, "least distance from the start", unit="m", minimum=0.0, maximum=1.5)
    start: tuple[float, ...] | None = setting(
        None,
        "joint angles at the start, within the arm's limits; null for its home posture",
        unit="rad",
        per_joint=True,
    )
    reach: float = setting(
        0.0,
        "reach of the arm that `start` and all lengths but `position` and `center` are for; other arms have them in "
        "proportion; 0 for as they are",
        unit="m",
        minimum=0.0,
        maximum=5.0,
    )
    start_position: tuple[float, ...] | None = setting(
        None,
        "where the tip of other arms starts, the axis of the last joint along x",
        unit="m",
        minimum=-1.5,
        maximum=1.5,
        optional_length=3,
    )
    position: tuple[float, ...] | None = setting(
        None, "the target, instead of one drawn in the box", unit="m", minimum=-1.5, maximum=1.5, optional_length=3
    )

    def start_of(self, arm: Arm) -> Array:
        """Joint angles at the start (n,), rad.

        Raises
        ------
        SettingsError
            If their number is not that of the arm's joints, or one is outside its limits.
        """
        if self.start is None:
            return np.array(arm.home)
        start = np.array(self.resolve(arm).start)
        for name, angle, lower, upper in zip(arm.joint_names, start, arm.lower, arm.upper, strict=True):
            if not lower <= angle <= upper:
                raise SettingsError(f"target: start = {self.start}: expected {name} in [{lower:.3f}, {upper:.3f}] rad")
        return start


@dataclass(frozen=True)
class MismatchSettings(Settings):
    """Differences of the simulated robot and its surroundings from the models of controller, observer and planner."""

    inertia_set: str = setting("alternative", "inertial parameters of the simulated arm: one of its sets")
    payload: float = setting(0.5, "unknown mass at the flange", unit="kg", minimum=0.0, maximum=14.0)
    friction_scale: float = setting(3.0, "factor on both joint frictions", minimum=0.0, maximum=20.0)
    noise_scale: float = setting(2.0, "factor on the noise of the joint sensors", minimum=0.0, maximum=100.0)
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
    """A concrete scene.

    Attributes
    ----------
    name
        Name of the YAML file.
    arm
        Arm that is simulated, and that target and obstacles were placed for.
    seed
        Seed of target and obstacles.
    start
        Joint angles, (n,), rad.
    target
        Flange position to reach, (3,), m, base frame.
    obstacles
        Obstacles; arrays with a row per sphere hold them one after the other.
    mismatch
        Differences of the simulation from the models.
    foam_scale
        Factor on all stiffnesses of the obstacles in the simulation; unknown to the planner.
    offsets
        (len(obstacles), 3) from where each obstacle is seen to where it is in the simulation, m; empty for none.
    environment
        Rigid bodies, which the arm must not touch.

    Raises
    ------
    SceneError
        If two obstacles have the same id.
    """

    name: str
    arm: Arm
    seed: int
    start: Array
    target: Array
    obstacles: tuple[Obstacle, ...] = ()
    mismatch: MismatchSettings = NO_MISMATCH
    foam_scale: float = 1.0
    environment: Environment = ()
    offsets: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        identifiers = [obstacle.id for obstacle in self.obstacles]
        if len(set(identifiers)) < len(identifiers):
            raise SceneError(f"scene '{self.name}': ids of obstacles are {identifiers}; expected each once")

    @property
    def true_obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles where they are in the simulation."""
        if not len(self.offsets):
            return self.obstacles
        pairs = zip(self.obstacles, self.offsets, strict=True)
        return tuple(replace(obstacle, rest=obstacle.rest + offset) for obstacle, offset in pairs)


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene's YAML file, its base included."""

    name: str
    target: TargetSettings
    obstacles: tuple[ObstacleSettings, ...] = ()
    mismatch: MismatchSettings = NO_MISMATCH
    source: str = field(default="", compare=False)
    """Path of the file, for messages; empty without a file."""
    environment: Environment = ()
    """Rigid bodies: floor, table and the like."""


def parse_target(text: str) -> Array | None:
    """Parse a position (3,) in m from 'x y z'; None for an empty text.

    Raises
    ------
    SceneError
        If it is not three finite numbers.
    """
    if not text.strip():
        return None
    try:
        position = np.array([float(word) for word in text.split()])
    except ValueError:
        position = np.empty(0)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise SceneError(f"target '{text}': expected three finite numbers 'x y z' in m")
    return position
