"""What cannot be: obstacles in the arm, targets in obstacles or out of reach, meshes too fine to simulate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.robot.workspace import unreachable
from contact_reach_ros.scenes.lattice import check_mesh, check_stiffness, make_walls
from contact_reach_ros.scenes.overlap import HAND_LINKS, LINKS, base_distances, capsule_segments, overlap_depths
from contact_reach_ros.scenes.scene import Ball, Scene, SceneFile, TargetSettings, Wall

Array = NDArray[np.float64]

_TOLERANCE = 1e-9
"""m."""
_HAND = np.isin(LINKS, HAND_LINKS)


def check_file(file: SceneFile) -> None:
    """Refuse a scene that no seed makes possible.

    Raises
    ------
    SceneError
        With the numbers that are wrong and what to change.
    """
    target = file.target
    if file.ball is not None:
        check_stiffness("ball", file.ball.stiffness + file.ball.contact_stiffness, file.ball.mass)
    if file.wall is not None:
        check_mesh(file.wall)
    if target.position is None:
        _check_box(target)
    else:
        check_reach(np.array(target.position))
    # Without a target of its own the scene is only looked at as it is at the start.
    balls, walls = given_obstacles(file)
    position = np.full(3, np.nan) if target.position is None else np.array(target.position)
    reason = conflict(Scene(file.name, 0, np.array(target.start), position, balls, walls))
    if reason:
        raise SceneError(reason)


def _check_box(target: TargetSettings) -> None:
    shoulder = np.array(iiwa14.SHOULDER_POSITION)
    nearest = np.clip(shoulder, target.minimum, target.maximum)
    if np.linalg.norm(nearest - shoulder) > iiwa14.MAX_REACH:
        raise SceneError(
            f"target: the nearest point of the box from minimum = {list(target.minimum)} to maximum = "
            f"{list(target.maximum)} {unreachable(nearest)}; move the box"
        )


def check_reach(target: Array) -> None:
    """Refuse a target (3,), m, that is out of reach or inside the base.

    Raises
    ------
    SceneError
        With how far away it is.
    """
    reason = unreachable(target)
    if reason:
        name = f"target {np.round(target, 3).tolist()} m"
        raise SceneError(f"{name} cannot be reached: its position {reason}; choose another target")


def given_obstacles(file: SceneFile) -> tuple[tuple[Ball, ...], tuple[Wall, ...]]:
    """The balls and walls whose place the file says."""
    balls: tuple[Ball, ...] = ()
    walls: tuple[Wall, ...] = ()
    if file.ball is not None and file.ball.center is not None:
        balls = (Ball(np.array(file.ball.center), file.ball),)
    if file.wall is not None and file.wall.center is not None:
        walls = make_walls(file.wall, np.array(file.wall.center))
    return balls, walls


def conflict(scene: Scene) -> str:
    """Why a scene is impossible, with the numbers; empty if it is not.

    An obstacle lies in the arm or its base at the start, the flange would be inside an obstacle at the target, or the
    hand, in the orientation of the start, would be inside a node there that cannot give way.
    """
    bodies = [_Body("the ball", "ball", ball.center[None], ball.settings.radius) for ball in scene.balls]
    for name, wall in zip(("lower", "upper"), scene.walls, strict=False):
        bodies.append(_Body(f"the {name} wall", "wall", wall.rest, wall.settings.node_radius, wall))
    starts, ends = capsule_segments(scene.start)
    shift = scene.target - link_frames(scene.start)[1][-1]
    hand = starts + shift, ends + shift
    reasons = (_start_conflict(body, starts, ends) or _target_conflict(body, scene.target, *hand) for body in bodies)
    return next(filter(None, reasons), "")


class _Body(NamedTuple):
    """One ball or wall, as spheres of one radius."""

    name: str
    section: str
    centers: Array
    radius: float
    wall: Wall | None = None

    def sphere(self, index: int) -> str:
        """One sphere in words."""
        place = f"at {np.round(self.centers[index], 3).tolist()} m, radius {self.radius:g} m"
        if self.wall is None:
            return f"{self.name} ({place})"
        node = tuple(int(number) for number in np.unravel_index(index, self.wall.settings.nodes))
        return f"node {node} of {self.name} ({place})"

    @property
    def remedy(self) -> str:
        return f"move {self.section}.center, or change"


def _start_conflict(body: _Body, starts: Array, ends: Array) -> str:
    depths = np.concatenate(
        [
            overlap_depths(starts, ends, body.centers, body.radius),
            (body.radius - base_distances(body.centers))[None],
        ]
    )
    part, index = np.unravel_index(depths.argmax(), depths.shape)
    depth = depths[part, index]
    if depth <= _TOLERANCE:
        return ""
    link = iiwa14.LINK_NAMES[LINKS[part] - 1] if part < len(LINKS) else iiwa14.BASE_NAME
    return (
        f"at the start {link} lies {1000 * depth:.1f} mm deep in {body.sphere(int(index))}; {body.remedy} target.start"
    )


def _target_conflict(body: _Body, target: Array, starts: Array, ends: Array) -> str:
    """NaN as a target is in conflict with nothing."""
    name = f"target {np.round(target, 3).tolist()} m"
    depths = body.radius - np.linalg.norm(body.centers - target, axis=1)
    index = int(depths.argmax())
    if depths[index] > _TOLERANCE:
        return f"{name} lies {1000 * depths[index]:.1f} mm inside {body.sphere(index)}; {body.remedy} the target"
    if body.wall is None:
        return ""
    in_hand = overlap_depths(starts, ends, body.centers, body.radius)[_HAND].max(axis=0)
    in_hand[~body.wall.fixed] = -np.inf
    index = int(in_hand.argmax())
    if in_hand[index] > _TOLERANCE:
        return (
            f"{name}: there the hand lies {1000 * in_hand[index]:.1f} mm deep in {body.sphere(index)}, which is fixed; "
            f"{body.remedy} the target"
        )
    return ""
