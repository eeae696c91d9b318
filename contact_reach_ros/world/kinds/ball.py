"""Balls: foam-like spheres in the way of elbow or forearm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.settings import setting
from contact_reach_ros.world.kinds.limits import check_overlaps, check_stiffness
from contact_reach_ros.world.obstacle import Material, Obstacle, ObstacleSettings
from contact_reach_ros.world.overlap import base_distances, on_hand, on_middle, overlap_depths, path_segments, radii

_TRIES = 200
_MIN_SWEEP = 0.05
"""A ball cannot block a part of the arm that moves less than this, m."""


@dataclass(frozen=True)
class BallSettings(ObstacleSettings):
    """A foam-like ball that a spring holds in place."""

    KIND: ClassVar[str] = "ball"
    NAME: ClassVar[str] = "a ball"

    radius: float = setting(0.1, "radius", unit="m", minimum=0.01, maximum=0.5)
    mass: float = setting(0.1, "mass", unit="kg", minimum=0.001, maximum=10.0)
    stiffness: float = setting(100.0, "spring that holds it in place", unit="N/m", minimum=1.0, maximum=5000.0)
    damping: float = setting(30.0, "damping of its motion", unit="N s/m", minimum=0.0, maximum=500.0)
    contact_stiffness: float = setting(1000.0, "stiffness of its surface", unit="N/m", minimum=50.0, maximum=50000.0)
    friction: float = setting(0.2, "sliding friction coefficient", minimum=0.0, maximum=2.0)
    min_overlap: float = setting(
        0.02, "least depth at which the free path would enter the ball", unit="m", minimum=0.0, maximum=0.2
    )
    max_overlap: float = setting(
        0.05, "greatest depth at which the free path would enter the ball", unit="m", minimum=0.0, maximum=0.2
    )
    hand_clearance: float = setting(
        0.02,
        "least distance of the hand, the last two links, from the ball on the free path",
        unit="m",
        minimum=0.0,
        maximum=0.5,
    )
    start_clearance: float = setting(
        0.01, "least distance of the arm from the ball at the start", unit="m", minimum=0.0, maximum=0.5
    )
    center: tuple[float, ...] | None = setting(
        None,
        "centre of the ball, instead of a random one on the free path",
        unit="m",
        minimum=-1.5,
        maximum=1.5,
        optional_length=3,
    )

    def check(self) -> None:
        """Refuse overlaps in the wrong order, and foam too stiff for the mass."""
        check_overlaps(self.KIND, self.min_overlap, self.max_overlap)
        check_stiffness(self.KIND, self.stiffness + self.contact_stiffness, self.mass)

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The ball at `center` (3,), m."""
        material = Material(self.mass, self.stiffness, self.damping, self.contact_stiffness, self.friction)
        return (Obstacle(self.KIND, "the ball", center[None], self.radius, material, np.zeros(1, bool)),)

    def place(self, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
        """A centre (3,) in the way of elbow or forearm on the path, but not of hand or start; None if none fits."""
        starts, ends = path_segments(arm, path)
        middle, hand = on_middle(arm), on_hand(arm)
        for _ in range(_TRIES):
            capsule = int(random.choice(np.flatnonzero(middle)))
            moment = int(random.uniform(0.3, 0.9) * len(path))
            along = random.uniform()
            points = starts[:, capsule] + along * (ends - starts)[:, capsule]
            if np.linalg.norm(points[moment] - points[0]) < _MIN_SWEEP:
                continue
            axis = ends[moment, capsule] - starts[moment, capsule]
            direction = points[moment] - points[moment - 5]
            direction -= axis * (direction @ axis) / (axis @ axis)
            direction /= max(float(np.linalg.norm(direction)), 1e-9)
            reach = radii(arm)[capsule] + self.radius - random.uniform(self.min_overlap, self.max_overlap)
            center: Array = points[moment] + reach * direction
            depths = overlap_depths(arm, starts, ends, center[None], self.radius)[..., 0]
            deepest = depths.max(axis=0)
            fits = self.min_overlap <= deepest[middle].max() <= self.max_overlap
            fits = fits and deepest[hand].max() <= -self.hand_clearance
            fits = fits and depths[0].max() <= -self.start_clearance
            fits = fits and deepest[~middle & ~hand].max(initial=-np.inf) <= 0.0
            if fits and base_distances(arm, center) > self.radius:
                return center
        return None
