"""The arm's constants, all read from the Brax system that Brax loads from the arm's MJCF.

Links, joints, limits and inertias are fields of the system; geometries, the tip and the custom fields of the MJCF are
those of the MuJoCo model behind it (`mj_model`), which Brax keeps in double precision.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array, link_frames, rotation_from_quaternion
from contact_reach_ros.arm.capsules import self_pairs
from contact_reach_ros.arm.mjcf import TIP_SITE, build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.resources import kept

if TYPE_CHECKING:
    import brax


_MOTIONS = 100
"""Random motions about home that a moving mass is found from."""


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Constants of the arm, with C capsules; link frames rotate with their joint, whose axis is the local z."""

    joint_offset: Array
    """(n, 3) origin of each link frame in the one before, m."""
    joint_rotation: Array
    """(n, 3, 3) rotation of each link frame in the one before at angle zero."""
    flange_offset: Array
    """(3,) flange in the last link frame, m."""
    flange_rotation: Array
    """(3, 3) rotation of the flange in the last link frame."""
    mass: Array
    """(n,), kg."""
    center_of_mass: Array
    """(n, 3) in the link frames, m."""
    inertia: Array
    """(n, 3, 3) about the centres of mass in the link frames, kg m²."""
    armature: Array
    """(n,), kg m²."""
    lower: Array
    """(n,) position limits, rad."""
    upper: Array
    """(n,), rad."""
    velocity_limit: Array
    """(n,), rad/s."""
    contact_links: tuple[str, ...]
    """Names of the L links that have capsules, from base to tip."""
    capsule_link: NDArray[np.intp]
    """(C,) link of each capsule, counted from 0."""
    capsule_place: NDArray[np.intp]
    """(C,) index of that link among `contact_links`."""
    capsule_start: Array
    """(C, 3) in the link frames, m."""
    capsule_axis: Array
    """(C, 3) from start to end in the link frames, m."""
    capsule_radius: Array
    """(C,), m."""
    end_mass: Array
    """(2, C) mass that moves with start and end of each capsule, kg: one in ten motions about home moves less."""
    base_start: Array
    """(F, 3) of the capsules that do not move, m."""
    base_axis: Array
    """(F, 3) from there to their ends, m."""
    base_radius: Array
    """(F,), m."""
    self_pairs: tuple[tuple[int, int], ...]
    """Pairs of capsules that can touch each other; those that do not move come first, those of the links follow."""

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.mass)


def load_system(mjcf_text: str) -> brax.System:
    """Load an MJCF into Brax."""
    configure_jax()
    import jax

    # Brax announces that it is no longer developed, and MuJoCo MJX that an optional GPU backend is missing; neither
    # is news to a user of this package.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from brax.io import mjcf

        # Constants, even when they are first requested while a program is being traced.
        with jax.ensure_compile_time_eval():
            return mjcf.loads(mjcf_text)


@functools.cache
def arm_model(arm: Arm) -> ArmModel:
    """The constants of an arm; each call returns the same object.

    What Brax has read from an MJCF is kept in the user's cache, since importing Brax takes longer than planning starts.
    """
    text = build_mjcf(arm)
    parts = (text, arm.digest, importlib.metadata.version("brax"), Path(__file__).read_text("utf-8"))
    return kept(parts, lambda: read_arm(arm, load_system(text)))


def read_arm(arm: Arm, system: brax.System) -> ArmModel:
    """The constants of an arm, as far as possible from a system that was loaded from its MJCF."""
    model = system.mj_model
    link, inertia = system.link, system.link.inertia
    joint_rotation = [_tidy(rotation_from_quaternion(quaternion)) for quaternion in _double(link.transform.rot)]
    to_link = [rotation_from_quaternion(quaternion) for quaternion in _double(inertia.transform.rot)]
    moments = _double(inertia.i)
    tensors = [rotation @ tensor @ rotation.T for rotation, tensor in zip(to_link, moments, strict=True)]
    # The base's capsules come first.
    geoms = np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    fixed = len(arm.base_capsules)
    bodies, radius = model.geom_bodyid[geoms[fixed:]], np.array(model.geom_size[geoms, 0])
    place = {body: number for number, body in enumerate(dict.fromkeys(bodies.tolist()))}
    # MuJoCo lets the z axis point from the second end to the first.
    half = [rotation_from_quaternion(model.geom_quat[geom])[:, 2] * model.geom_size[geom, 1] for geom in geoms]
    start, end = _exact(model.geom_pos[geoms] + half), _exact(model.geom_pos[geoms] - half)
    axis = end - start
    return ArmModel(
        joint_offset=_double(link.transform.pos),
        joint_rotation=np.array(joint_rotation),
        flange_offset=_exact(model.site(TIP_SITE).pos),
        flange_rotation=_tidy(rotation_from_quaternion(model.site(TIP_SITE).quat)),
        mass=_double(inertia.mass),
        center_of_mass=_double(inertia.transform.pos),
        inertia=np.array([_tidy(tensor) for tensor in tensors]),
        armature=_double(system.dof.armature),
        lower=_double(system.dof.limit[0]),
        upper=_double(system.dof.limit[1]),
        velocity_limit=arm.velocity_limits,
        contact_links=tuple(model.body(body).name for body in place),
        capsule_link=bodies - 1,
        capsule_place=np.array([place[body] for body in bodies.tolist()]),
        capsule_start=start[fixed:],
        capsule_axis=axis[fixed:],
        capsule_radius=radius[fixed:],
        end_mass=np.array([_moving_mass(arm, bodies - 1, points) for points in (start[fixed:], end[fixed:])]),
        base_start=start[:fixed],
        base_axis=axis[:fixed],
        base_radius=radius[:fixed],
        self_pairs=self_pairs(arm),
    )


def _moving_mass(arm: Arm, links: NDArray[np.intp], points: Array) -> Array:
    """Mass (C,), kg, that moves with points (C, 3), m, in the frames of links (C,); see `ArmModel.end_mass`."""
    model, random = RobotModel(arm), np.random.default_rng(0)
    masses = []
    for _ in range(_MOTIONS):
        q = np.clip(np.array(arm.home) + random.uniform(-0.6, 0.6, arm.n), arm.lower, arm.upper)
        v = random.standard_normal(arm.n)
        model.update_dynamics(q)
        rotations, origins = (np.array(part[: arm.n]) for part in link_frames(arm, q))
        levers = origins[links, None] + (rotations[links] @ points[:, :, None]).transpose(0, 2, 1) - origins
        moves = np.arange(arm.n) <= links[:, None]
        rows = np.cross(rotations[:, :, 2], levers) * moves[:, :, None]
        direction = v @ rows
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
        torques = np.einsum("cnx,cx->nc", rows, direction)
        masses.append(1.0 / ((torques * np.linalg.solve(model.mass_matrix, torques)).sum(axis=0) + 1e-9))
    return np.quantile(masses, 0.1, axis=0)


def _double(values: object) -> Array:
    return np.asarray(values, dtype=np.float64)


def _exact(values: object) -> Array:
    """Lengths as the MJCF has them, without the rounding errors of their conversion, m."""
    rounded: Array = np.round(_double(values), 12)
    return rounded + 0.0  # no negative zeros


def _tidy(matrix: Array) -> Array:
    """Remove rounding errors of single precision next to 0 and ±1, which would cost multiplications."""
    rounded = np.round(matrix)
    return np.where(np.abs(matrix - rounded) < 1e-6, rounded, matrix)
