"""Forward kinematics straight from the table, and the change between its two descriptions (numpy, no model library)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.iiwa14 import Inertia

Array = NDArray[np.float64]


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a quaternion (w, x, y, z), which need not be normalised."""
    w, x, y, z = np.asarray(quaternion, dtype=float) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_about(axis: ArrayLike, angle: float) -> Array:
    """Rotation matrix (3, 3) about a unit axis by an angle in rad."""
    x, y, z = axis = np.asarray(axis, dtype=float)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.cos(angle) * np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * np.outer(axis, axis)


_OFFSETS = np.array([joint.offset for joint in iiwa14.JOINTS])
_ROTATIONS = np.array([rotation_from_quaternion(joint.rotation) for joint in iiwa14.JOINTS])


def link_frames(q: ArrayLike) -> tuple[list[Array], list[Array]]:
    """Rotations (3, 3) and origins (3,) of the seven link frames, then the flange, in the base frame."""
    angles = np.asarray(q, dtype=float)
    turns = np.zeros((iiwa14.N_JOINTS, 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0] = np.sin(angles)
    turns[:, 0, 1] = -turns[:, 1, 0]
    turns[:, 2, 2] = 1.0
    rotation, origin = np.eye(3), np.zeros(3)
    rotations, origins = [], []
    for offset, step in zip(_OFFSETS, _ROTATIONS @ turns, strict=True):
        origin = origin + rotation @ offset
        rotation = rotation @ step
        rotations.append(rotation)
        origins.append(origin)
    return [*rotations, rotation], [*origins, origin + rotation @ iiwa14.FLANGE_OFFSET]


def link_frames_of_many(q: Array) -> tuple[Array, Array]:
    """The same as `link_frames` for postures `q` (N, 7), with the posture last.

    Returns the axes (8, 3, 3, N) of the frames, indexed [frame, axis, coordinate], and the origins (8, 3, N).
    """
    cosine, sine = np.cos(q.T), np.sin(q.T)
    axes, origins = np.empty((8, 3, 3, len(q))), np.empty((8, 3, len(q)))
    frame, origin = np.repeat(np.eye(3)[:, :, None], len(q), axis=2), np.zeros((3, len(q)))
    for joint, (offset, step) in enumerate(zip(_OFFSETS, _ROTATIONS, strict=True)):
        flat = frame.reshape(3, -1)
        origin = origins[joint] = origin + (offset @ flat).reshape(3, -1)
        x, y, z = (step.T @ flat).reshape(3, 3, -1)
        frame = axes[joint]
        frame[0] = cosine[joint] * x + sine[joint] * y
        frame[1] = cosine[joint] * y - sine[joint] * x
        frame[2] = z
    axes[7] = frame
    origins[7] = origin + (np.array(iiwa14.FLANGE_OFFSET) @ frame.reshape(3, -1)).reshape(3, -1)
    return axes, origins


def flange_positions(q: Array) -> Array:
    """Positions (N, 3) of the flange, m, base frame, for postures `q` (N, 7), rad."""
    return link_frames_of_many(q)[1][-1].T


def aligned_link_frames(q: ArrayLike) -> tuple[list[Array], list[Array]]:
    """The same as `link_frames` for the second description, whose frames are parallel to the base at angle zero."""
    rotation, origin = np.eye(3), np.zeros(3)
    rotations, origins = [], []
    table = zip(iiwa14.ALIGNED_ORIGINS, iiwa14.ALIGNED_AXES, np.asarray(q, dtype=float), strict=True)
    for offset, axis, angle in table:
        origin = origin + rotation @ offset
        rotation = rotation @ rotation_about(axis, angle)
        rotations.append(rotation)
        origins.append(origin)
    return [*rotations, rotation], [*origins, origin + rotation @ iiwa14.ALIGNED_FLANGE_OFFSET]


def tensor_matrix(tensor: tuple[float, ...]) -> Array:
    """Symmetric matrix (3, 3) of an inertia given as (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = tensor
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def link_inertias(inertia_set: str) -> tuple[Inertia, ...]:
    """The inertial parameters of the seven links in the frames of `iiwa14.JOINTS`.

    Raises
    ------
    SettingsError
        If there is no such set.
    """
    if inertia_set == "nominal":
        return iiwa14.NOMINAL_INERTIAS
    if inertia_set != "alternative":
        raise SettingsError(f"inertia set '{inertia_set}' is unknown; expected one of {', '.join(iiwa14.INERTIA_SETS)}")
    zero = np.zeros(iiwa14.N_JOINTS)
    frames = zip(*link_frames(zero), *aligned_link_frames(zero), strict=True)
    converted = []
    for inertia, (to_rotation, to_origin, from_rotation, from_origin) in zip(
        iiwa14.ALIGNED_INERTIAS, frames, strict=False
    ):
        rotation = to_rotation.T @ from_rotation
        center = to_rotation.T @ (from_origin + from_rotation @ inertia.center - to_origin)
        tensor = rotation @ tensor_matrix(inertia.tensor) @ rotation.T
        six = (tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2])
        converted.append(Inertia(inertia.mass, tuple(map(float, center)), tuple(map(float, six))))  # type: ignore[arg-type]
    return tuple(converted)
