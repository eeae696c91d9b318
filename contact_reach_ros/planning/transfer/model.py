"""The arm's constants, taken from the Brax system that is loaded from its MJCF."""

from __future__ import annotations

import contextlib
import functools
import io
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import rotation_from_quaternion
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arrays import Array
from contact_reach_ros.planning.runtime import configure_jax

if TYPE_CHECKING:
    import brax


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Constants of the arm, with C capsules; link frames rotate with their joint, whose axis is the local z."""

    table: Arm
    """Arm that the constants come from."""
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
    capsule_link: NDArray[np.intp]
    """(C,) link of each capsule, counted from 0."""
    capsule_place: NDArray[np.intp]
    """(C,) index of that link among the arm's `contact_links`."""
    capsule_start: Array
    """(C, 3) in the link frames, m."""
    capsule_axis: Array
    """(C, 3) from start to end in the link frames, m."""
    capsule_radius: Array
    """(C,), m."""

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.table.n


def load_system(arm: Arm) -> brax.System:
    """Load the arm into Brax."""
    configure_jax()
    import jax

    # Brax announces that it is no longer developed, and MuJoCo MJX that an optional GPU backend is missing; neither
    # is news to a user of this package.
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from brax.io import mjcf

        # Constants, even when they are first requested while a program is being traced.
        with jax.ensure_compile_time_eval():
            return mjcf.loads(build_mjcf(arm))


@functools.cache
def arm_model(arm: Arm) -> ArmModel:
    """The constants of an arm; each call returns the same object."""
    system = load_system(arm)
    link, inertia = system.link, system.link.inertia
    joint_rotation = [_tidy(rotation_from_quaternion(quaternion)) for quaternion in _double(link.transform.rot)]
    to_link = [rotation_from_quaternion(quaternion) for quaternion in _double(inertia.transform.rot)]
    tensors = [rotation @ tensor @ rotation.T for rotation, tensor in zip(to_link, _double(inertia.i), strict=True)]
    capsules = arm.capsules
    links = [arm.link_names[capsule.link - 1] for capsule in capsules]
    return ArmModel(
        table=arm,
        joint_offset=_double(link.transform.pos),
        joint_rotation=np.array(joint_rotation),
        flange_offset=np.array(arm.tip_offset),
        flange_rotation=rotation_from_quaternion(arm.tip_rotation),
        mass=_double(inertia.mass),
        center_of_mass=_double(inertia.transform.pos),
        inertia=np.array([_tidy(tensor) for tensor in tensors]),
        armature=_double(system.dof.armature),
        lower=_double(system.dof.limit[0]),
        upper=_double(system.dof.limit[1]),
        velocity_limit=arm.velocity_limits,
        capsule_link=np.array([capsule.link - 1 for capsule in capsules]),
        capsule_place=np.array([arm.contact_links.index(link) for link in links]),
        capsule_start=np.array([capsule.start for capsule in capsules], dtype=float),
        capsule_axis=np.array([np.subtract(capsule.end, capsule.start) for capsule in capsules]),
        capsule_radius=np.array([capsule.radius for capsule in capsules]),
    )


def _double(values: object) -> Array:
    return np.asarray(values, dtype=np.float64)


def _tidy(matrix: Array) -> Array:
    """Remove rounding errors of single precision next to 0 and ±1, which would cost multiplications."""
    rounded = np.round(matrix)
    return np.where(np.abs(matrix - rounded) < 1e-6, rounded, matrix)
