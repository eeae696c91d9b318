"""Boxes: deformable lattices that stand where the scene file places them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arrays import Array
from contact_reach_ros.settings import setting
from contact_reach_ros.world.kinds.lattice import Lattice
from contact_reach_ros.world.obstacle import Material, Obstacle, ObstacleSettings


@dataclass(frozen=True)
class BoxSettings(ObstacleSettings):
    """A deformable box whose lowest nodes are fixed."""

    KIND: ClassVar[str] = "box"
    NAME: ClassVar[str] = "a box"

    center: tuple[float, ...] = setting((0.5, -0.3, 0.15), "centre", unit="m", minimum=-1.5, maximum=1.5)
    size: tuple[float, ...] = setting((0.2, 0.2, 0.3), "size along x, y, z", unit="m", minimum=0.02, maximum=3.0)
    angles: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "roll, pitch and yaw about the axes of the base", unit="rad", minimum=-6.3, maximum=6.3
    )
    nodes: tuple[int, ...] = setting((3, 3, 4), "number of nodes along x, y, z", minimum=2, maximum=50)
    node_radius: float = setting(0.025, "radius of a node", unit="m", minimum=0.005, maximum=0.2)
    node_mass: float = setting(0.01, "mass of a node", unit="kg", minimum=0.001, maximum=1.0)
    edge_stiffness: float = setting(40.0, "spring between two nodes", unit="N/m", minimum=1.0, maximum=5000.0)
    damping: float = setting(5.0, "damping of a node's motion", unit="N s/m", minimum=0.1, maximum=500.0)
    contact_stiffness: float = setting(1000.0, "stiffness of its surface", unit="N/m", minimum=50.0, maximum=50000.0)
    friction: float = setting(0.2, "sliding friction coefficient", minimum=0.0, maximum=2.0)

    @property
    def material(self) -> Material:
        """Material whose nodes have no springs of their own: the edges hold them."""
        return Material(
            self.node_mass, 0.0, self.damping, self.contact_stiffness, self.friction, edge_stiffness=self.edge_stiffness
        )

    def check(self) -> None:
        """Refuse meshes that cannot be simulated."""
        self._lattice.check(self.KIND, "the box", self.material)

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The box around `center` (3,), m."""
        lattice = self._lattice
        return (
            Obstacle(
                self.KIND,
                "the box",
                center + Rotation.from_euler("xyz", self.angles).apply(lattice.points(np.zeros(3))),
                self.node_radius,
                self.material,
                fixed=lattice.level(0),
                edges=lattice.edges(),
                lattice=lattice.nodes,
            ),
        )

    @property
    def _lattice(self) -> Lattice:
        return Lattice(self.size, self.nodes, self.node_radius)
