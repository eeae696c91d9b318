"""The arm's constants, drawn from the Brax system that is loaded from the package's MJCF."""

from __future__ import annotations

import contextlib
import functools
import io
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import rotation_from_quaternion
from contact_reach_ros.robot.mjcf import build_mjcf

if TYPE_CHECKING:
    import brax

Array = NDArray[np.float64]

N_LINKS = iiwa14.N_JOINTS
N_CAPSULES = len(iiwa14.CAPSULES)


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Constants of the arm; link frames rotate with their joint, whose axis is the local z."""

    joint_offset: Array
    """(7, 3) origin of each link frame in the one before, m."""
    joint_rotation: Array
    """(7, 3, 3) rotation of each link frame in the one before at angle zero."""
    flange_offset: Array
    """(3,) flange in the last link frame, m."""
    mass: Array
    """(7,), kg."""
    center_of_mass: Array
    """(7, 3) in the link frames, m."""
    inertia: Array
    """(7, 3, 3) about the centres of mass in the link frames, kg m²."""
    armature: Array
    """(7,), kg m²."""
    position_limit: Array
    """(7,) symmetric, rad."""
    velocity_limit: Array
    """(7,), rad/s."""
    capsule_link: NDArray[np.intp]
    """(6,) link of each capsule, counted from 0."""
    capsule_start: Array
    """(6, 3) in the link frames, m."""
    capsule_axis: Array
    """(6, 3) from start to end in the link frames, m."""
    capsule_radius: Array
    """(6,), m."""


def load_system() -> brax.System:
    """Load the arm into Brax."""
    configure_jax()
    import jax

    # Brax announces that it is no longer developed, and MuJoCo MJX that an optional GPU backend is missing; neither
    # is news to a user of this package.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from brax.io import mjcf

        # Constants, even when they are first asked for while a program is being traced.
        with jax.ensure_compile_time_eval():
            return mjcf.loads(build_mjcf())


def arm_model(system: brax.System) -> ArmModel:
    """The constants of a Brax system that is this arm, with or without obstacles."""
    link, inertia = system.link, system.link.inertia
    joint_rotation = [_tidy(rotation_from_quaternion(quaternion)) for quaternion in _double(link.transform.rot)]
    to_link = [rotation_from_quaternion(quaternion) for quaternion in _double(inertia.transform.rot)]
    tensors = [rotation @ tensor @ rotation.T for rotation, tensor in zip(to_link, _double(inertia.i), strict=True)]
    capsules = iiwa14.CAPSULES
    return ArmModel(
        joint_offset=_double(link.transform.pos),
        joint_rotation=np.array(joint_rotation),
        flange_offset=np.array(iiwa14.FLANGE_OFFSET),
        mass=_double(inertia.mass),
        center_of_mass=_double(inertia.transform.pos),
        inertia=np.array([_tidy(tensor) for tensor in tensors]),
        armature=_double(system.dof.armature),
        position_limit=_double(system.dof.limit[1]),
        velocity_limit=np.array(iiwa14.VELOCITY_LIMITS),
        capsule_link=np.array([capsule.link - 1 for capsule in capsules]),
        capsule_start=np.array([capsule.start for capsule in capsules], dtype=float),
        capsule_axis=np.array([np.subtract(capsule.end, capsule.start) for capsule in capsules]),
        capsule_radius=np.array([capsule.radius for capsule in capsules]),
    )


@functools.cache
def default_arm() -> ArmModel:
    """The arm of this package."""
    return arm_model(load_system())


def _double(values: object) -> Array:
    return np.asarray(values, dtype=np.float64)


def _tidy(matrix: Array) -> Array:
    """Without the rounding errors of single precision next to 0 and ±1, which would cost multiplications by them."""
    rounded = np.round(matrix)
    return np.where(np.abs(matrix - rounded) < 1e-6, rounded, matrix)
