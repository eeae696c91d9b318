"""Obstacles of any kind: bodies of soft spheres, and the sections of scene files that define them."""

from __future__ import annotations

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.settings import Settings, setting


@dataclass(frozen=True)
class Material:
    """Properties of each sphere of an obstacle and of the edges between its spheres.

    Attributes
    ----------
    mass
        Mass of a sphere, kg.
    stiffness
        Stiffness of the spring that holds a sphere in place, N/m.
    damping
        Damping of a sphere's motion, N s/m.
    contact_stiffness
        Contact stiffness of the surface, N/m.
    friction
        Sliding friction coefficient.
    edge_stiffness
        k of the spring along an edge, N/m.
    hardening
        h: a simulated edge of length l whose ends have moved apart by s has the stiffness k (1 + h (s / l)²).
    planner_scale
        Factor on `stiffness` and `edge_stiffness` in the planner's model, which does not harden.
    """

    mass: float
    stiffness: float
    damping: float
    contact_stiffness: float
    friction: float
    edge_stiffness: float = 0.0
    hardening: float = 0.0
    planner_scale: float = 1.0


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One body of a concrete scene: spheres of one radius and material, held by springs and joined by edges.

    An edge resists any change of the vector between its ends, in all directions alike.

    Attributes
    ----------
    kind
        Key of its section in the scene file.
    name
        Name in messages to the user, such as 'the lower wall'.
    rest
        (K, 3) centres of the spheres when nothing pushes them, m, base frame.
    radius
        Radius of each sphere, m.
    material
        Material of spheres and edges.
    fixed
        (K,) true for the spheres that cannot move.
    id
        Number that is unique in its scene.
    edges
        (E, 2) indices of the spheres that each edge joins; none by default.
    lattice
        Numbers of spheres along x, y and z if they form a lattice, z counting fastest; else empty.
    """

    kind: str
    name: str
    rest: Array
    radius: float
    material: Material
    fixed: NDArray[np.bool_]
    id: int = 0
    edges: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    lattice: tuple[int, ...] = ()

    @property
    def is_deformable(self) -> bool:
        """Whether it is a mesh of joined spheres, rather than spheres that move on their own."""
        return len(self.edges) > 0


def numbered(obstacles: Iterable[Obstacle]) -> tuple[Obstacle, ...]:
    """The same obstacles with ids from 0."""
    return tuple(dataclasses.replace(obstacle, id=number) for number, obstacle in enumerate(obstacles))


@dataclass(frozen=True)
class ObstacleSettings(Settings, ABC):
    """Section of a scene file that puts obstacles of one kind into the scene.

    A kind is a dataclass that derives from this one, with an entry in `world.kinds.KINDS`.

    Attributes
    ----------
    KIND
        Key of the section.
    NAME
        Name of its obstacles in messages to the user, such as 'a ball'.
    TARGET_TRIES
        Number of targets to try before `place` gives up.
    center
        Position of the obstacles in the scene file, m, base frame; None to let `place` choose it.
    id
        Number of the first of them; -1 for the next one that is free.
    """

    KIND: ClassVar[str]
    NAME: ClassVar[str]
    TARGET_TRIES: ClassVar[int] = 200

    center: tuple[float, ...] | None = setting(
        None, "centre, instead of a random one", unit="m", minimum=-1.5, maximum=1.5, optional_length=3
    )
    id: int = setting(
        -1, "number of its first body, unique in the scene; -1 for the next one that is free", minimum=-1, maximum=9999
    )

    @abstractmethod
    def check(self) -> None:
        """Refuse obstacles that cannot be placed or simulated with any arm and seed.

        Raises
        ------
        SceneError, SettingsError
            If they cannot; the message gives the numbers and what to change.
        """

    @abstractmethod
    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The obstacles around `center` (3,), m, base frame."""

    def suited_to(self, arm: Arm, postures: Array) -> Self:
        """These settings for an arm that they were scaled for, with what does not depend on its reach alone.

        `postures`: those in which it holds the start's orientation in the middle of the targets, (N, n), rad.
        """
        return self

    def place(self, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
        """A random centre (3,), m, of obstacles on the arm's free path (N, n), rad; None if none fits.

        A kind whose `center` has a default does not need this method.
        """
        return None

    @property
    def limits(self) -> str:
        """Settings to relax if `place` finds nothing, in words; empty if none."""
        return ""


def bodies(sections: Sequence[ObstacleSettings], centers: Sequence[Array]) -> tuple[Obstacle, ...]:
    """The obstacles of sections around their centres (3,), m, with the ids that the sections ask for.

    Bodies of the same name get their id in it.
    """
    groups = [section.at(center) for section, center in zip(sections, centers, strict=True)]
    taken = {
        section.id + k
        for section, group in zip(sections, groups, strict=True)
        if section.id >= 0
        for k in range(len(group))
    }
    free = (number for number in itertools.count() if number not in taken)
    found = [
        dataclasses.replace(body, id=next(free) if section.id < 0 else section.id + number)
        for section, group in zip(sections, groups, strict=True)
        for number, body in enumerate(group)
    ]
    names = Counter(body.name for body in found)
    return tuple(
        body if names[body.name] == 1 else dataclasses.replace(body, name=f"{body.name} {body.id}") for body in found
    )
