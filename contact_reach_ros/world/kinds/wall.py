"""Walls: two deformable lattices around the hand's path, in the way of elbow and forearm."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.settings import setting
from contact_reach_ros.world.kinds.lattice import Lattice
from contact_reach_ros.world.kinds.limits import check_overlaps
from contact_reach_ros.world.obstacle import Material, Obstacle, ObstacleSettings
from contact_reach_ros.world.overlap import (
    height,
    holding_segments,
    on_hand,
    on_middle,
    overlap_depths,
    path_segments,
    radii,
)

_TRIES = 40
_SPREAD = 0.01
"""How far the gap's centre may be above or below that of the passing hand, m."""
_GAP_SHARE = 0.94
"""Of the least height at which an arm gets through: the gap for other arms than the one that a scene is for."""
_PATH_STEP = 5


@dataclass(frozen=True)
class WallSettings(ObstacleSettings):
    """Two deformable walls, one above the other, with a gap that the arm cannot pass without pushing.

    Each is a lattice of small spheres, the nodes, joined by springs. The row of nodes farthest from the gap is fixed.
    """

    KIND: ClassVar[str] = "wall"
    NAME: ClassVar[str] = "walls"
    TARGET_TRIES: ClassVar[int] = 20
    """Few, because the search for a place takes long."""

    size: tuple[float, ...] = setting((0.1, 1.0, 0.2), "size of one wall: x, y, z", unit="m", minimum=0.02, maximum=3.0)
    nodes: tuple[int, ...] = setting((2, 11, 3), "number of nodes of one wall along x, y, z", minimum=2, maximum=50)
    node_radius: float = setting(0.025, "radius of a node", unit="m", minimum=0.005, maximum=0.2)
    node_mass: float = setting(0.01, "mass of a node", unit="kg", minimum=0.001, maximum=1.0)
    edge_stiffness: float = setting(
        40.0, "spring between two nodes, when hardly deformed", unit="N/m", minimum=1.0, maximum=5000.0
    )
    hardening: float = setting(
        0.3, "relative increase in stiffness of a spring deformed by its own length", minimum=0.0, maximum=10.0
    )
    anchor_stiffness: float = setting(
        0.0, "spring that holds each node in place, besides the fixed row", unit="N/m", minimum=0.0, maximum=5000.0
    )
    damping: float = setting(5.0, "damping of a node's motion", unit="N s/m", minimum=0.1, maximum=500.0)
    contact_stiffness: float = setting(1000.0, "stiffness of its surface", unit="N/m", minimum=50.0, maximum=50000.0)
    friction: float = setting(0.2, "sliding friction coefficient", minimum=0.0, maximum=2.0)
    planner_stiffness_scale: float = setting(
        1.0,
        "factor on the springs in the planner's mesh, which does not harden; benchmarks/foam.py --fit finds it",
        minimum=0.05,
        maximum=20.0,
    )
    gap: float = setting(0.15, "gap between the walls", unit="m", minimum=0.0, maximum=1.0)
    min_overlap: float = setting(
        0.04,
        "least depth at which links from the third to the hand would enter a node on the free path",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    max_overlap: float = setting(
        0.15,
        "greatest depth at which links from the third to the hand would enter a node on the free path",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    max_hand_overlap: float = setting(
        0.02,
        "greatest depth at which the hand, the last two links, would enter a node on the free path",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    min_squeeze: float = setting(
        0.005,
        "least depth at which the arm enters a node in every posture that holds the target pose",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    start_clearance: float = setting(
        0.01, "least distance of the arm from the walls at the start", unit="m", minimum=0.0, maximum=0.5
    )
    target_clearance: float = setting(
        0.06, "least distance of the target behind the walls", unit="m", minimum=0.0, maximum=1.0
    )
    center: tuple[float, ...] | None = setting(
        None,
        "centre of the gap, instead of a random one on the free path",
        unit="m",
        minimum=-1.5,
        maximum=1.5,
        optional_length=3,
    )

    @property
    def material(self) -> Material:
        """Material of both walls."""
        return Material(
            mass=self.node_mass,
            stiffness=self.anchor_stiffness,
            damping=self.damping,
            contact_stiffness=self.contact_stiffness,
            friction=self.friction,
            edge_stiffness=self.edge_stiffness,
            hardening=self.hardening,
            planner_scale=self.planner_stiffness_scale,
        )

    @property
    def limits(self) -> str:
        """Gap and overlaps."""
        return (
            f"the walls' limits: gap = {self.gap:g} m, overlap {self.min_overlap:g} to {self.max_overlap:g} m, "
            f"max_hand_overlap = {self.max_hand_overlap:g} m"
        )

    def check(self) -> None:
        """Refuse overlaps in the wrong order, and meshes that cannot be simulated."""
        check_overlaps(self.KIND, self.min_overlap, self.max_overlap)
        self._lattice.check(self.KIND, "the two walls", self.material, copies=2)

    def suited_to(self, arm: Arm, postures: Array) -> Self:
        """With a gap that is as narrow for the arm as 0.15 m is for the iiwa 14.

        What counts is the posture in which the part of the arm that is in the walls or behind them is lowest, when the
        target is as near as it may be: that of an iiwa's hand with the elbow aside.
        """
        depth = self.size[0] + self.target_clearance
        return dataclasses.replace(self, gap=_GAP_SHARE * min(height(arm, q, depth) for q in postures))

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The lower and the upper wall around a gap whose centre is at `center` (3,), m.

        Raises
        ------
        SceneError, SettingsError
            As `check`.
        """
        self.check()
        lattice, edges = self._lattice, self._lattice.edges()
        offset = np.array([0.0, 0.0, 0.5 * (self.gap + self.size[2])])
        places = (("the lower wall", center - offset, 0), ("the upper wall", center + offset, -1))
        return tuple(
            Obstacle(
                self.KIND,
                name,
                lattice.points(middle),
                self.node_radius,
                self.material,
                lattice.level(fixed_level),
                id=number,
                edges=edges,
                lattice=lattice.nodes,
            )
            for number, (name, middle, fixed_level) in enumerate(places)
        )

    def place(self, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
        """A centre of the gap (3,) on the hand's path; None if none fits.

        The start is clear of the walls, the target lies behind them, elbow or forearm would push into them on the path,
        and no posture that holds the target pose is free of contact, so that there is no collision-free path.
        """
        starts, ends = path_segments(arm, np.concatenate([path[:-1:_PATH_STEP], path[-1:]]))
        holding = holding_segments(arm, path[-1])
        hand, middle = on_hand(arm), on_middle(arm)
        points = np.concatenate([starts[:, hand], ends[:, hand]], axis=1)
        reach = np.tile(radii(arm)[hand], 2)
        hand_middles = 0.5 * ((points[..., 2] + reach).max(axis=1) + (points[..., 2] - reach).min(axis=1))
        hand_x = ends[:, hand][:, -1, 0]
        half_thickness = 0.5 * self.size[0]
        nearest, farthest = hand_x[0] + half_thickness, hand_x[-1] - half_thickness - self.target_clearance
        if nearest > farthest:
            return None
        for _ in range(_TRIES):
            x = random.uniform(nearest, farthest)
            z = hand_middles[np.abs(hand_x - x).argmin()] + random.uniform(-_SPREAD, _SPREAD)
            center = np.array([x, 0.0, z])
            nodes = np.concatenate([wall.rest for wall in self.at(center)])
            if overlap_depths(arm, starts[0], ends[0], nodes, self.node_radius).max() > -self.start_clearance:
                continue
            deepest = overlap_depths(arm, starts, ends, nodes, self.node_radius).max(axis=(0, 2))
            fits = self.min_overlap <= deepest[middle].max() <= self.max_overlap
            fits = fits and deepest[hand].max() <= self.max_hand_overlap
            if fits:
                squeezes = overlap_depths(arm, *holding, nodes, self.node_radius).max(axis=(1, 2))
                if squeezes.min() >= self.min_squeeze:
                    return center
        return None

    @property
    def _lattice(self) -> Lattice:
        return Lattice(self.size, self.nodes, self.node_radius)
