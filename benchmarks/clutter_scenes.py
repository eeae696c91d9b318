"""Scenes that nobody designed: soft bodies, start and target at random, fixed by a seed."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm import Arm, link_frames
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.obstacle import BallSettings, BoxSettings, ObstacleSettings
from contact_reach_ros.world.rigid import Plane
from contact_reach_ros.world.scene_file import SceneFile, TargetSettings

FIRST_HELD_OUT = 10_000
"""Seeds from here on are run once, for the page of results; nothing is tuned on them."""

MAX_BODIES = 8
_STREAM = 22
_PLACES = (0.1, -0.7, 0.0), (0.9, 0.7, 1.0)
"""Corners of the box for the bodies' centres, m."""
_TARGETS = (0.2, -0.5, 0.1), (0.75, 0.5, 0.8)
_STIFFNESS = 50.0, 2000.0
"""N/m, uniform in its logarithm."""
_JOINT_MARGIN = 0.3
"""Of the start from the joints' limits, rad."""
_MIN_DISTANCE = 0.2
_TRIES = 100
_FLOOR = Plane("floor", (0.0, 0.0, -0.1), (0.0, 0.0, 1.0))


def clutter_name(seed: int) -> str:
    """Name of the scene with this seed."""
    return f"clutter_{seed:05d}"


def clutter_scene(arm: Arm, seed: int) -> SceneFile:
    """One to eight balls, boxes and walls with a start and a target.

    Bodies stay as they are drawn; start and target are drawn again where `make_scene` refuses them: a start in contact,
    a target in a body or without a posture that reaches it in the orientation of the start. Where none is found in 100
    tries, the bodies are drawn again, too.
    """
    random = np.random.default_rng((_STREAM, seed))
    while True:
        bodies = tuple(_body(random) for _ in range(random.integers(1, MAX_BODIES + 1)))
        for _ in range(_TRIES):
            lower, upper = np.array(arm.lower) + _JOINT_MARGIN, np.array(arm.upper) - _JOINT_MARGIN
            start, target = random.uniform(lower, upper), random.uniform(*_TARGETS)
            if np.linalg.norm(link_frames(arm, start)[1][-1] - target) < _MIN_DISTANCE:
                continue
            place = TargetSettings(start=tuple(start.tolist()), position=tuple(target.tolist()))
            file = SceneFile(clutter_name(seed), place, bodies, environment=(_FLOOR,))
            try:
                make_scene(file, arm, seed)
            except ContactReachError:
                continue
            return file


def _body(random: np.random.Generator) -> ObstacleSettings:
    center = tuple(random.uniform(*_PLACES).tolist())
    stiffness = float(np.exp(random.uniform(*np.log(_STIFFNESS))))
    kind = random.choice(["ball", "box", "wall"])
    if kind == "ball":
        return BallSettings(center=center, radius=float(random.uniform(0.05, 0.15)), stiffness=stiffness)
    nodes = (2, 2, 3) if kind == "box" else (2, int(random.integers(3, 7)), 3)
    radius = float(random.uniform(0.03, 0.05))
    return BoxSettings(
        center=center,
        size=tuple(2.0 * radius * count + 1e-6 for count in nodes),
        nodes=nodes,
        node_radius=radius,
        node_mass=0.02,
        edge_stiffness=stiffness,
        angles=(0.0, 0.0, float(random.uniform(-np.pi, np.pi))),
    )
