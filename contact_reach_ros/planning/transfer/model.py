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

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.kinematics import rotation_from_quaternion
from contact_reach_ros.arm.mjcf import SELF_PAIRS, TIP_SITE, VELOCITY_LIMITS, build_mjcf
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.runtime import configure_jax
from contact_reach_ros.resources import KeptFile

if TYPE_CHECKING:
    import brax

_CAPSULE = 3
"""MuJoCo's number of this type of geometry."""


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
    base_start: Array
    """(3,) of the capsule that does not move, m."""
    base_axis: Array
    """(3,) from there to its end, m."""
    base_radius: float
    """m."""
    self_pairs: tuple[tuple[int, int], ...]
    """Pairs of capsules that can touch each other; the base's has number 0, those of the links follow."""

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
    kept = KeptFile("arms", text, importlib.metadata.version("brax"), Path(__file__).read_text())
    model: ArmModel | None = kept.load()
    if model is None:
        model = read_arm(load_system(text))
        kept.store(model)
    return model


def read_arm(system: brax.System) -> ArmModel:
    """The constants of the arm in a system; its other links are obstacle spheres, which slide.

    Raises
    ------
    SettingsError
        If the links are no serial arm of hinges about their z axes, or a geometry is none that the kernel knows.
    """
    links = np.flatnonzero([kind == "1" for kind in system.link_types])
    dofs = np.array([system.dof_ranges()[link][0] for link in links], int)
    _check_joints(system, links, dofs)
    model = system.mj_model
    link, inertia = system.link, system.link.inertia
    joint_rotation = [_tidy(rotation_from_quaternion(quaternion)) for quaternion in _double(link.transform.rot)[links]]
    to_link = [rotation_from_quaternion(quaternion) for quaternion in _double(inertia.transform.rot)[links]]
    moments = _double(inertia.i)[links]
    tensors = [rotation @ tensor @ rotation.T for rotation, tensor in zip(to_link, moments, strict=True)]
    geoms, bodies = _capsules(system, links)
    place = {body: number for number, body in enumerate(dict.fromkeys(bodies[1:].tolist()))}
    start, axis = _segments(system, geoms)
    pairs = custom_field(system, SELF_PAIRS)
    pairs = np.zeros(0) if pairs is None else pairs
    return ArmModel(
        joint_offset=_double(link.transform.pos)[links],
        joint_rotation=np.array(joint_rotation),
        flange_offset=_exact(model.site(TIP_SITE).pos),
        flange_rotation=_tidy(rotation_from_quaternion(model.site(TIP_SITE).quat)),
        mass=_double(inertia.mass)[links],
        center_of_mass=_double(inertia.transform.pos)[links],
        inertia=np.array([_tidy(tensor) for tensor in tensors]),
        armature=_double(system.dof.armature)[dofs],
        lower=_double(system.dof.limit[0])[dofs],
        upper=_double(system.dof.limit[1])[dofs],
        velocity_limit=np.array(model.numeric(VELOCITY_LIMITS).data),
        contact_links=tuple(model.body(body).name for body in place),
        capsule_link=np.searchsorted(links + 1, bodies[1:]),
        capsule_place=np.array([place[body] for body in bodies[1:].tolist()]),
        capsule_start=start[1:],
        capsule_axis=axis[1:],
        capsule_radius=np.array(model.geom_size[geoms[1:], 0]),
        base_start=start[0],
        base_axis=axis[0],
        base_radius=float(model.geom_size[geoms[0], 0]),
        self_pairs=tuple((int(first), int(second)) for first, second in pairs.reshape(-1, 2)),
    )


def _check_joints(system: brax.System, links: NDArray[np.intp], dofs: NDArray[np.intp]) -> None:
    """Refuse what the kernel would compute wrongly."""
    names = np.array(system.link_names)
    if set(system.link_types) - {"1", "3"} or not len(links):
        raise SettingsError(
            f"links {system.link_names} of types '{system.link_types}': expected hinges ('1'), and spheres on three "
            "sliders ('3')"
        )
    parents = np.array(system.link_parents)[links]
    if not np.array_equal(parents, [-1, *links[:-1]]):
        raise SettingsError(f"links {names[links].tolist()} with parents {parents.tolist()}: expected one chain")
    axes = np.concatenate([_double(system.dof.motion.ang)[dofs], _double(system.link.joint.pos)[links]], axis=1)
    if not np.allclose(axes, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0], atol=1e-6):
        raise SettingsError("expected joints that turn about the z axes of their links; give the links such frames")
    limits = (np.inf,) if system.dof.limit is None else [_double(limit)[dofs] for limit in system.dof.limit]
    if not np.isfinite(limits).all():
        raise SettingsError("expected position limits of all joints; add range to each joint of the MJCF")
    if np.any(_double(system.dof.stiffness)[dofs]) or np.any(_double(system.dof.damping)[dofs]):
        raise SettingsError("expected joints without springs and dampers, which the control law would not know")
    if custom_field(system, VELOCITY_LIMITS, len(links)) is None:
        raise SettingsError(f"expected the custom field {VELOCITY_LIMITS}, one for each of {len(links)} joints, rad/s")
    sites = [system.mj_model.site(index).name for index in range(system.mj_model.nsite)]
    if TIP_SITE not in sites or system.mj_model.site(TIP_SITE).bodyid != links[-1] + 1:
        raise SettingsError(f"sites {sites}: expected '{TIP_SITE}', the tip, on the last link")


def _capsules(system: brax.System, links: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Geometries of base and links, the base's first, and the bodies that they are on."""
    model = system.mj_model
    on_arm = np.isin(model.geom_bodyid, links + 1) | (model.geom_bodyid == 0)
    geoms = np.flatnonzero(on_arm & ((model.geom_contype != 0) | (model.geom_conaffinity != 0)))
    other = [model.geom(geom).name for geom in geoms if model.geom_type[geom] != _CAPSULE]
    bodies = model.geom_bodyid[geoms]
    if other or np.count_nonzero(bodies == 0) != 1 or len(geoms) < 2:
        names = [model.geom(geom).name for geom in geoms]
        raise SettingsError(
            f"geometries {names}, no capsules: {other}; expected one capsule of the base, others on links"
        )
    return geoms, bodies


def _segments(system: brax.System, geoms: NDArray[np.intp]) -> tuple[Array, Array]:
    """Starts of capsules and vectors from there to their ends, (C, 3) each, m."""
    model = system.mj_model
    # MuJoCo lets the z axis point from the second end to the first.
    half = [rotation_from_quaternion(model.geom_quat[geom])[:, 2] * model.geom_size[geom, 1] for geom in geoms]
    middle = model.geom_pos[geoms]
    start, end = _exact(middle + half), _exact(middle - half)
    return start, end - start


def custom_field(system: brax.System, name: str, size: int | None = None) -> Array | None:
    """Values of a custom field of the MJCF; None if there is no such field.

    Raises
    ------
    SettingsError
        If it has not as many values as expected.
    """
    model = system.mj_model
    for index in range(model.nnumeric):
        field = model.numeric(index)
        if field.name == name:
            if size not in (None, len(field.data)):
                raise SettingsError(f"custom field {name} has {len(field.data)} values; expected {size}")
            return np.array(field.data)
    return None


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
