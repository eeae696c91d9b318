"""What stands around the arm: scenes are YAML files, made concrete by a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings, setting

Array = NDArray[np.float64]

JOINTS = iiwa14.N_JOINTS


@dataclass(frozen=True)
class TargetSettings(Settings):
    """The box in which targets are drawn, and where episodes start."""

    minimum: tuple[float, ...] = setting((0.2, -0.3, 0.0), "lower corner", unit="m", minimum=-1.5, maximum=1.5)
    maximum: tuple[float, ...] = setting((0.6, 0.3, 0.5), "upper corner", unit="m", minimum=-1.5, maximum=1.5)
    min_distance: float = setting(0.2, "least distance from the start", unit="m", minimum=0.0, maximum=1.5)
    start: tuple[float, ...] = setting(
        iiwa14.HOME_POSITION, "joint angles at the start", unit="rad", minimum=-3.05, maximum=3.05
    )
    position: tuple[float, ...] | None = setting(
        None, "the target, instead of one drawn in the box", unit="m", minimum=-1.5, maximum=1.5, optional_length=3
    )


@dataclass(frozen=True)
class BallSettings(Settings):
    """A foam-like ball, held to its place by a spring."""

    radius: float = setting(0.1, "radius", unit="m", minimum=0.01, maximum=0.5)
    mass: float = setting(0.1, "mass", unit="kg", minimum=0.001, maximum=10.0)
    stiffness: float = setting(100.0, "spring to its place", unit="N/m", minimum=1.0, maximum=5000.0)
    damping: float = setting(30.0, "damping of its motion", unit="N s/m", minimum=0.0, maximum=500.0)
    contact_stiffness: float = setting(1000.0, "of the foam itself", unit="N/m", minimum=50.0, maximum=50000.0)
    friction: float = setting(0.2, "sliding friction coefficient", minimum=0.0, maximum=2.0)
    min_overlap: float = setting(
        0.02, "least depth at which the free path would enter the ball", unit="m", minimum=0.0, maximum=0.2
    )
    max_overlap: float = setting(
        0.05, "greatest depth at which the free path would enter the ball", unit="m", minimum=0.0, maximum=0.2
    )
    hand_clearance: float = setting(
        0.02, "least distance of links 6 and 7 from the ball on the free path", unit="m", minimum=0.0, maximum=0.5
    )
    start_clearance: float = setting(
        0.01, "least distance of the arm from the ball at the start", unit="m", minimum=0.0, maximum=0.5
    )
    center: tuple[float, ...] | None = setting(
        None,
        "where the ball is, instead of a place on the free path",
        unit="m",
        minimum=-1.5,
        maximum=1.5,
        optional_length=3,
    )


@dataclass(frozen=True)
class Ball:
    """One ball of a concrete scene: where its spring holds it, (3,) m in the base frame, and what it is made of."""

    center: Array
    settings: BallSettings


@dataclass(frozen=True)
class WallSettings(Settings):
    """Two deformable walls, one above the other, with a gap that the arm cannot pass without pushing.

    Each is a lattice of small spheres, the nodes, joined by springs along the lattice. The row of nodes farthest from
    the gap is fixed. A spring resists any change of the vector between its ends, as the spring joints of the paper do.
    """

    size: tuple[float, ...] = setting((0.1, 1.0, 0.2), "of one wall along x, y, z", unit="m", minimum=0.02, maximum=3.0)
    nodes: tuple[int, ...] = setting((2, 11, 3), "of one wall along x, y, z", minimum=2, maximum=50)
    node_radius: float = setting(0.025, "radius of a node", unit="m", minimum=0.005, maximum=0.2)
    node_mass: float = setting(0.01, "mass of a node", unit="kg", minimum=0.001, maximum=1.0)
    edge_stiffness: float = setting(
        40.0, "of a spring between two nodes, when hardly deformed", unit="N/m", minimum=1.0, maximum=5000.0
    )
    hardening: float = setting(
        0.3, "share by which a spring is stiffer when its ends moved apart by its length", minimum=0.0, maximum=10.0
    )
    anchor_stiffness: float = setting(
        0.0, "spring from each node to its place, besides the fixed row", unit="N/m", minimum=0.0, maximum=5000.0
    )
    damping: float = setting(5.0, "damping of a node's motion", unit="N s/m", minimum=0.1, maximum=500.0)
    contact_stiffness: float = setting(1000.0, "of the foam itself", unit="N/m", minimum=50.0, maximum=50000.0)
    friction: float = setting(0.2, "sliding friction coefficient", minimum=0.0, maximum=2.0)
    planner_stiffness_scale: float = setting(
        1.0,
        "factor on the springs in the planner's mesh, which does not harden; bench foam --fit finds it",
        minimum=0.05,
        maximum=20.0,
    )
    gap: float = setting(0.15, "between the walls", unit="m", minimum=0.0, maximum=1.0)
    min_overlap: float = setting(
        0.04,
        "least depth at which links 3 to 5 would enter a node on the free path",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    max_overlap: float = setting(
        0.15,
        "greatest depth at which links 3 to 5 would enter a node on the free path",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    max_hand_overlap: float = setting(
        0.02,
        "greatest depth at which links 6 and 7 would enter a node on the free path",
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
        "where the middle of the gap is, instead of a place on the free path",
        unit="m",
        minimum=-1.5,
        maximum=1.5,
        optional_length=3,
    )

    @property
    def planner_edge_stiffness(self) -> float:
        """Of a spring between two nodes in the planner's mesh, N/m."""
        return self.planner_stiffness_scale * self.edge_stiffness

    @property
    def planner_anchor_stiffness(self) -> float:
        """Of the spring from a node to its place in the planner's mesh, N/m."""
        return self.planner_stiffness_scale * self.anchor_stiffness


@dataclass(frozen=True, eq=False)
class Wall:
    """One wall of a concrete scene: a lattice of nodes joined by edges."""

    rest: Array
    """(N, 3) where the nodes are when nothing pushes them, m, base frame."""
    edges: NDArray[np.intp]
    """(E, 2) indices of the nodes that each edge joins."""
    fixed: NDArray[np.bool_]
    """(N,) whether a node cannot move."""
    settings: WallSettings


@dataclass(frozen=True)
class MismatchSettings(Settings):
    """How the simulated robot and its surroundings differ from what controller, observer and planner know."""

    inertia_set: str = setting("alternative", "inertial parameters of the simulated arm", choices=iiwa14.INERTIA_SETS)
    payload: float = setting(0.5, "unknown mass at the flange", unit="kg", minimum=0.0, maximum=14.0)
    friction_scale: float = setting(3.0, "factor on both joint frictions", minimum=0.0, maximum=20.0)
    noise_scale: float = setting(2.0, "factor on the noise of the joint sensors", minimum=0.0, maximum=100.0)
    foam_variation: float = setting(
        0.3,
        "greatest share by which the simulated foam is stiffer or softer, drawn by the seed",
        minimum=0.0,
        maximum=0.9,
    )


NO_MISMATCH = MismatchSettings("nominal", payload=0.0, friction_scale=1.0, noise_scale=1.0, foam_variation=0.0)
"""What the simulated robot is without a mismatch."""


@dataclass(frozen=True)
class Scene:
    """A concrete scene.

    Attributes
    ----------
    name
        Of the YAML file.
    seed
        What target and obstacles were drawn from.
    start
        Joint angles, (7,), rad.
    target
        Flange position to reach, (3,), m, base frame.
    balls, walls
        Obstacles. Where they are listed by sphere, balls come first, then the nodes of one wall after the other.
    mismatch
        How the simulation differs from the models.
    foam_scale
        Factor on all stiffnesses of the obstacles in the simulation, which the planner does not know.
    """

    name: str
    seed: int
    start: Array
    target: Array
    balls: tuple[Ball, ...] = ()
    walls: tuple[Wall, ...] = ()
    mismatch: MismatchSettings = NO_MISMATCH
    foam_scale: float = 1.0


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene's YAML file, its base included."""

    name: str
    target: TargetSettings
    ball: BallSettings | None = None
    wall: WallSettings | None = None
    mismatch: MismatchSettings = NO_MISMATCH


def parse_target(text: str) -> Array | None:
    """A position (3,) in m from 'x y z'; None for an empty text.

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
