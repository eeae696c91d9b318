"""Obstacles, bodies of soft spheres, and kinds of them in scene files: balls, boxes and walls."""

from __future__ import annotations

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Settings, setting

_ALONG = np.linspace(0.0, 1.0, 21)
"""Places along a link, as shares of its length."""
BOTTOM, MIDDLE = "bottom", "middle"
"""Nodes of a box that are fixed."""


@dataclass(frozen=True)
class Material:
    """Properties of each sphere of an obstacle and of the edges between its spheres."""

    mass: float
    """Mass of a sphere, kg."""
    stiffness: float
    """Stiffness of the spring that holds a sphere in place, N/m."""
    damping: float
    """Damping of a sphere's motion, N s/m."""
    contact_stiffness: float
    """Contact stiffness of the surface, N/m."""
    friction: float
    """Sliding friction coefficient."""
    edge_stiffness: float = 0.0
    """k of the spring along an edge, N/m."""
    hardening: float = 0.0
    """h: a simulated edge of length l whose ends have moved apart by s has the stiffness k (1 + h (s / l)²)."""


@dataclass(frozen=True)
class Bending:
    """Chains of links in place of movable spheres: how the simulation has a body that is fixed at its first sphere.

    A sphere is at the end of each link that moves. Joints are at all spheres of a stem but the first and the last, and
    halfway from the first to the second.
    """

    stems: tuple[tuple[int, ...], ...]
    """Spheres of each stem, from the fixed one on."""
    masses: tuple[tuple[float, ...], ...]
    """Of the links of each stem that move, kg."""
    fruits: tuple[float, ...]
    """Mass at the end of each stem in addition, which touches nothing, kg."""
    stiffness: float
    """Of a joint, about both axes across the link, N m/rad."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One body of a concrete scene: spheres of one radius and material, held by springs and joined by edges.

    An edge resists any change of the vector between its ends, in all directions alike.
    """

    kind: str
    """Key of its section in the scene file."""
    name: str
    """Name in messages to the user, such as 'the lower wall'."""
    rest: Array
    """(K, 3) centres of the spheres when nothing pushes them, m, base frame."""
    radius: float
    """Radius of each sphere, m."""
    material: Material
    """Material of spheres and edges."""
    fixed: NDArray[np.bool_]
    """(K,) true for the spheres that cannot move."""
    edges: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    """(E, 2) indices of the spheres that each edge joins; none by default."""
    edge_stiffness: Array = field(default_factory=lambda: np.zeros(0))
    """(E,) N/m; that of the material by default."""
    bending: Bending | None = None
    """How it bends; None for a body whose movable spheres have springs and dampers of their own."""

    def __post_init__(self) -> None:
        if not len(self.edge_stiffness):
            object.__setattr__(self, "edge_stiffness", np.full(len(self.edges), self.material.edge_stiffness))

    @property
    def outline(self) -> Array:
        """(N, 3) centres of spheres of its radius that fill what of it can be touched, m."""
        if self.bending is None:
            return self.rest
        start, end = np.moveaxis(self.rest[self.edges], 1, 0)[:, :, None]
        return (start + _ALONG[:, None] * (end - start)).reshape(-1, 3)

    @property
    def is_deformable(self) -> bool:
        """Whether it is a mesh of joined spheres, rather than spheres that move on their own."""
        return len(self.edges) > 0


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
    contact_stiffness: float = setting(1000.0, "stiffness of its surface", unit="N/m", minimum=50.0, maximum=50000.0)
    friction: float = setting(0.2, "sliding friction coefficient", minimum=0.0, maximum=2.0)

    def drawn(self, random: np.random.Generator) -> ObstacleSettings:
        """These settings with what they leave to the seed."""
        return self

    def goals(self, center: Array) -> Array:
        """Positions (G, 3), m, that the scene's target is drawn from where it is not given; most kinds have none."""
        return np.zeros((0, 3))

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
    fixed: bool = setting(False, "whether it stays where it is, whatever pushes it")

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The ball at `center` (3,), m."""
        material = Material(self.mass, self.stiffness, self.damping, self.contact_stiffness, self.friction)
        return (Obstacle(self.KIND, "the ball", center[None], self.radius, material, np.array([self.fixed])),)


@dataclass(frozen=True)
class MeshSettings(ObstacleSettings):
    """A deformable body: a box-shaped lattice of spheres, the nodes, joined by springs along its axes.

    The surfaces of the outer nodes touch the sides of the box. Edges hold the nodes, one level of which is fixed.
    """

    HARDENING: ClassVar[float] = 0.0
    """Of the springs in the simulation, as `Material.hardening`."""

    size: tuple[float, ...] = setting((0.2, 0.2, 0.3), "size along x, y, z", unit="m", minimum=0.02, maximum=3.0)
    nodes: tuple[int, ...] = setting((3, 3, 4), "number of nodes along x, y, z", minimum=2, maximum=50)
    node_radius: float = setting(0.025, "radius of a node", unit="m", minimum=0.005, maximum=0.2)
    node_mass: float = setting(0.01, "mass of a node", unit="kg", minimum=0.001, maximum=1.0)
    edge_stiffness: float = setting(
        40.0, "spring between two nodes, when hardly deformed", unit="N/m", minimum=1.0, maximum=5000.0
    )
    damping: float = setting(5.0, "damping of a node's motion", unit="N s/m", minimum=0.1, maximum=500.0)

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

    def _body(self, name: str, points: Array, held: tuple[slice | int, ...]) -> Obstacle:
        fixed = np.zeros(self.nodes, bool)
        fixed[held] = True
        material = Material(
            self.node_mass,
            0.0,
            self.damping,
            self.contact_stiffness,
            self.friction,
            self.edge_stiffness,
            self.HARDENING,
        )
        return Obstacle(self.KIND, name, points, self.node_radius, material, fixed.ravel(), edges=self.edges())


@dataclass(frozen=True)
class BoxSettings(MeshSettings):
    """A deformable box that is fixed at its lowest nodes, or in its middle."""

    KIND: ClassVar[str] = "box"

    center: tuple[float, ...] = setting((0.5, -0.3, 0.15), "its centre", unit="m", minimum=-1.5, maximum=1.5)
    angles: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "roll, pitch and yaw about the axes of the base", unit="rad", minimum=-6.3, maximum=6.3
    )
    fixed: str = setting(
        BOTTOM,
        "nodes that cannot move: the lowest, or all but the outer rows along y",
        choices=(BOTTOM, MIDDLE),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fixed == MIDDLE and self.nodes[1] < 3:
            raise SettingsError(f"box: nodes = {self.nodes}: expected 3 or more along y where fixed is {MIDDLE}")

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The box around `center` (3,), m."""
        turned = self.points(np.zeros(3)) @ pin.rpy.rpyToMatrix(*self.angles).T
        held = np.s_[:, :, 0] if self.fixed == BOTTOM else np.s_[:, 1:-1, :]
        return (self._body("the box", center + turned, held),)


@dataclass(frozen=True)
class WallSettings(MeshSettings):
    """Two deformable walls, one above the other, with a gap that the arm cannot pass without pushing.

    `center` is the middle of the gap; the row of nodes farthest from it is fixed.
    """

    KIND: ClassVar[str] = "wall"
    HARDENING: ClassVar[float] = 0.3
    """With it and the default stiffness, nodes pressed with 10 N yield within 15 % as far as those of the planner's
    mesh, which does not harden."""

    size: tuple[float, ...] = setting((0.1, 1.0, 0.2), "size of one wall: x, y, z", unit="m", minimum=0.02, maximum=3.0)
    nodes: tuple[int, ...] = setting((2, 11, 3), "number of nodes of one wall along x, y, z", minimum=2, maximum=50)
    gap: float = setting(0.15, "gap between the walls", unit="m", minimum=0.0, maximum=1.0)

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The lower and the upper wall around a gap whose centre is at `center` (3,), m."""
        offset = np.array([0.0, 0.0, 0.5 * (self.gap + self.size[2])])
        lower = self._body("the lower wall", self.points(center - offset), np.s_[:, :, 0])
        upper = self._body("the upper wall", self.points(center + offset), np.s_[:, :, -1])
        return lower, upper


def bodies(sections: Sequence[ObstacleSettings], centers: Sequence[Array]) -> tuple[Obstacle, ...]:
    """The obstacles of sections around their centres (3,), m; equal names get a number."""
    found = [body for section, center in zip(sections, centers, strict=True) for body in section.at(center)]
    count = Counter(body.name for body in found)
    return tuple(
        body if count[body.name] == 1 else dataclasses.replace(body, name=f"{body.name} {number}")
        for number, body in enumerate(found)
    )
