"""The kinds of obstacles in scene files: balls, boxes and walls, with their keys and the bodies that they stand for."""

from __future__ import annotations

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.world.obstacle import Material, Obstacle


def _limit(default: float, meaning: str, maximum: float = 0.2) -> float:
    """A length, m, that limits where a random obstacle may be."""
    return setting(default, meaning, unit="m", minimum=0.0, maximum=maximum)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class ObstacleSettings(Settings, ABC):
    """Section of a scene file that puts obstacles of one kind into the scene; `KIND` is its key."""

    KIND: ClassVar[str]

    center: tuple[float, ...] | None = setting(
        None,
        "its centre, instead of a random one on the arm's free path",
        unit="m",
        minimum=-1.5,
        maximum=1.5,
        optional_length=3,
    )
    id: int = setting(
        -1, "number of its first body, unique in the scene; -1 for the next one that is free", minimum=-1, maximum=9999
    )
    contact_stiffness: float = setting(1000.0, "stiffness of its surface", unit="N/m", minimum=50.0, maximum=50000.0)
    friction: float = setting(0.2, "sliding friction coefficient", minimum=0.0, maximum=2.0)

    @property
    @abstractmethod
    def material(self) -> Material:
        """Material of its spheres and edges."""

    @abstractmethod
    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The obstacles around `center` (3,), m, base frame."""


@dataclass(frozen=True)
class BallSettings(ObstacleSettings):
    """A foam-like ball that a spring holds in place."""

    KIND: ClassVar[str] = "ball"

    radius: float = setting(0.1, "radius", unit="m", minimum=0.01, maximum=0.5)
    mass: float = setting(0.1, "mass", unit="kg", minimum=0.001, maximum=10.0)
    stiffness: float = setting(100.0, "spring that holds it in place", unit="N/m", minimum=1.0, maximum=5000.0)
    damping: float = setting(30.0, "damping of its motion", unit="N s/m", minimum=0.0, maximum=500.0)
    min_overlap: float = _limit(0.02, "least depth at which the free path would enter the ball")
    max_overlap: float = _limit(0.05, "greatest depth at which the free path would enter the ball")
    hand_clearance: float = _limit(
        0.02, "least distance of the hand, the last two links, from the ball on the free path", maximum=0.5
    )
    start_clearance: float = _limit(0.01, "least distance of the arm from the ball at the start", maximum=0.5)

    @property
    def material(self) -> Material:
        """Material of the ball."""
        return Material(self.mass, self.stiffness, self.damping, self.contact_stiffness, self.friction)

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The ball at `center` (3,), m."""
        return (Obstacle(self.KIND, "the ball", center[None], self.radius, self.material, np.zeros(1, bool)),)


@dataclass(frozen=True)
class MeshSettings(ObstacleSettings):
    """A deformable body: a box-shaped lattice of spheres, the nodes, joined by springs along its axes.

    The surfaces of the outer nodes touch the sides of the box. Edges hold the nodes, one level of which is fixed.
    """

    size: tuple[float, ...] = setting((0.2, 0.2, 0.3), "size along x, y, z", unit="m", minimum=0.02, maximum=3.0)
    nodes: tuple[int, ...] = setting((3, 3, 4), "number of nodes along x, y, z", minimum=2, maximum=50)
    node_radius: float = setting(0.025, "radius of a node", unit="m", minimum=0.005, maximum=0.2)
    node_mass: float = setting(0.01, "mass of a node", unit="kg", minimum=0.001, maximum=1.0)
    edge_stiffness: float = setting(
        40.0, "spring between two nodes, when hardly deformed", unit="N/m", minimum=1.0, maximum=5000.0
    )
    damping: float = setting(5.0, "damping of a node's motion", unit="N s/m", minimum=0.1, maximum=500.0)

    @property
    def material(self) -> Material:
        """Material of nodes and edges."""
        return Material(
            self.node_mass, 0.0, self.damping, self.contact_stiffness, self.friction, edge_stiffness=self.edge_stiffness
        )

    def points(self, center: Array) -> Array:
        """Centres of the nodes (N, 3), m, z counting fastest, of a box around `center` (3,)."""
        extents = 0.5 * np.array(self.size) - self.node_radius
        axes = [np.linspace(-extent, extent, count) for extent, count in zip(extents, self.nodes, strict=True)]
        return center + np.array(list(itertools.product(*axes)))

    def edges(self) -> NDArray[np.intp]:
        """Pairs (E, 2) of neighbours along the three axes."""
        index = np.arange(np.prod(self.nodes)).reshape(self.nodes)
        along = (np.moveaxis(index, axis, 0) for axis in range(3))
        return np.concatenate([np.stack([line[:-1].ravel(), line[1:].ravel()], axis=1) for line in along])

    def level(self, number: int) -> NDArray[np.bool_]:
        """(N,) true for the nodes on one level along z; -1 is the top."""
        mask = np.zeros(self.nodes, bool)
        mask[:, :, number] = True
        return mask.ravel()

    def _body(self, name: str, points: Array, fixed_level: int) -> Obstacle:
        fixed = self.level(fixed_level)
        return Obstacle(
            self.KIND, name, points, self.node_radius, self.material, fixed, edges=self.edges(), lattice=self.nodes
        )


@dataclass(frozen=True)
class BoxSettings(MeshSettings):
    """A deformable box whose lowest nodes are fixed."""

    KIND: ClassVar[str] = "box"

    center: tuple[float, ...] = setting((0.5, -0.3, 0.15), "its centre", unit="m", minimum=-1.5, maximum=1.5)
    angles: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "roll, pitch and yaw about the axes of the base", unit="rad", minimum=-6.3, maximum=6.3
    )

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The box around `center` (3,), m."""
        turned = Rotation.from_euler("xyz", self.angles).apply(self.points(np.zeros(3)))
        return (self._body("the box", center + turned, 0),)


@dataclass(frozen=True)
class WallSettings(MeshSettings):
    """Two deformable walls, one above the other, with a gap that the arm cannot pass without pushing.

    `center` is the middle of the gap; the row of nodes farthest from it is fixed.
    """

    KIND: ClassVar[str] = "wall"

    size: tuple[float, ...] = setting((0.1, 1.0, 0.2), "size of one wall: x, y, z", unit="m", minimum=0.02, maximum=3.0)
    nodes: tuple[int, ...] = setting((2, 11, 3), "number of nodes of one wall along x, y, z", minimum=2, maximum=50)
    hardening: float = setting(
        0.3, "relative increase in stiffness of a spring deformed by its own length", minimum=0.0, maximum=10.0
    )
    anchor_stiffness: float = setting(
        0.0, "spring that holds each node in place, besides the fixed row", unit="N/m", minimum=0.0, maximum=5000.0
    )
    planner_stiffness_scale: float = setting(
        1.0, "factor on the springs in the planner's mesh, which does not harden", minimum=0.05, maximum=20.0
    )
    gap: float = setting(0.15, "gap between the walls", unit="m", minimum=0.0, maximum=1.0)
    min_overlap: float = _limit(
        0.04, "least depth at which links from the third to the hand would enter a node on the free path"
    )
    max_overlap: float = _limit(
        0.15, "greatest depth at which links from the third to the hand would enter a node on the free path"
    )
    max_hand_overlap: float = _limit(
        0.02, "greatest depth at which the hand, the last two links, would enter a node on the free path"
    )
    min_squeeze: float = _limit(
        0.005, "least depth at which the arm enters a node in every posture that holds the target pose"
    )
    start_clearance: float = _limit(0.01, "least distance of the arm from the walls at the start", maximum=0.5)
    target_clearance: float = _limit(0.06, "least distance of the target behind the walls", maximum=1.0)

    @property
    def material(self) -> Material:
        """Material of both walls."""
        return dataclasses.replace(
            super().material,
            stiffness=self.anchor_stiffness,
            hardening=self.hardening,
            planner_scale=self.planner_stiffness_scale,
        )

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The lower and the upper wall around a gap whose centre is at `center` (3,), m."""
        offset = np.array([0.0, 0.0, 0.5 * (self.gap + self.size[2])])
        lower = self._body("the lower wall", self.points(center - offset), 0)
        upper = self._body("the upper wall", self.points(center + offset), -1)
        return lower, dataclasses.replace(upper, id=1)


KINDS: dict[str, type[ObstacleSettings]] = {kind.KIND: kind for kind in (BallSettings, BoxSettings, WallSettings)}
"""The kinds by the key of their section; a scene lists its obstacles in this order."""


def bodies(sections: Sequence[ObstacleSettings], centers: Sequence[Array]) -> tuple[Obstacle, ...]:
    """The obstacles of sections around their centres (3,), m, with the ids that the sections ask for.

    Bodies of the same name get their id in it.
    """
    pairs = [(section, section.at(center)) for section, center in zip(sections, centers, strict=True)]
    taken = {section.id + k for section, group in pairs if section.id >= 0 for k in range(len(group))}
    free = (number for number in itertools.count() if number not in taken)
    found = [
        dataclasses.replace(body, id=next(free) if section.id < 0 else section.id + k)
        for section, group in pairs
        for k, body in enumerate(group)
    ]
    names = Counter(body.name for body in found)
    return tuple(
        body if names[body.name] == 1 else dataclasses.replace(body, name=f"{body.name} {body.id}") for body in found
    )
