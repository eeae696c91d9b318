"""An arm as a value: kinematics, limits, inertial parameters, collision capsules and default thresholds.

Every model in this package (MJCF for MuJoCo, Brax and Pinocchio, URDF for `robot_description`) is built from one `Arm`.
Units are SI: m, kg, rad, N m, s.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError, SettingsError

if TYPE_CHECKING:
    from contact_reach_ros.arm.tool import Tool

Array = NDArray[np.float64]
"""Double precision; docstrings give shape, unit and frame."""
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

PARALLEL: Quaternion = (1.0, 0.0, 0.0, 0.0)
"""Rotation (w, x, y, z) of a frame whose axes are those of the frame that it is in."""

STANDING: Vector3 = (0.0, 0.0, -9.81)
"""Gravity in the axes of a base that stands upright, m/s²."""


@dataclass(frozen=True)
class Joint:
    """One revolute joint about the z axis of the link that it moves, with that link's frame in the previous link."""

    name: str
    offset: Vector3
    """Origin of the link frame, m."""
    rotation: Quaternion
    """Rotation (w, x, y, z) of the link frame at angle zero, not necessarily normalised."""
    lower: float
    """Lower position limit, rad."""
    upper: float
    """Upper position limit, rad."""
    velocity_limit: float
    """rad/s."""
    torque_limit: float
    """N m."""
    armature: float
    """Reflected inertia of motor and gears, kg m²."""


@dataclass(frozen=True)
class Inertia:
    """Inertial parameters of one link in its frame; `tensor` is (xx, yy, zz, xy, xz, yz) about the centre of mass."""

    mass: float
    center: Vector3
    tensor: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Capsule:
    """Collision shape on one link, in its frame: a segment from `start` to `end` thickened by `radius`, m."""

    link: int
    """Number of the link, counted from 1 as the joints are; 0 is the base."""
    start: Vector3
    end: Vector3
    radius: float
    name: str = ""
    """Of the link that it is on, where `link` does not say it: one that is fixed to the base."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A serial arm with revolute joints. Arms of equal digest are equal, and an arm can be a key.

    Attributes
    ----------
    name
        Name that `load_arm` takes, and that bags record.
    joints
        From base to tip.
    link_names
        Names of the links that the joints move, in the same order.
    base_frame, tip_frame
        Frame that goals are given in, and frame that is to reach them.
    tip_offset
        Position of the tip in the frame of the last link, m.
    capsules
        Collision shapes of the moving links, from base to tip.
    base_capsules
        Collision shapes that do not move: those of the base, of all links that are fixed to it, and of a first link
        that only turns about its own axis.
    inertia_sets
        Inertial parameters of the links by name of the set; controller and observer use 'nominal'.
    shoulder, reach
        Point in the base frame, and the greatest distance of the tip from it at which goals are accepted, m.
    home
        Joint angles at which episodes start unless a scene specifies others, rad.
    defaults
        Per-joint values of the settings that depend on the arm, by the name of the setting; others are zero.
    tip_rotation
        Rotation (w, x, y, z) of the tip frame in the frame of the last link, not necessarily normalised.
    gravity
        Acceleration of gravity in the base frame, m/s²; along -z unless the base is tilted.
    bare
        The same arm without its tool; None if it has none.
    """

    name: str
    joints: tuple[Joint, ...]
    link_names: tuple[str, ...]
    base_frame: str
    tip_frame: str
    tip_offset: Vector3
    capsules: tuple[Capsule, ...]
    base_capsules: tuple[Capsule, ...]
    inertia_sets: Mapping[str, tuple[Inertia, ...]]
    shoulder: Vector3
    reach: float
    home: tuple[float, ...]
    defaults: Mapping[str, tuple[float, ...]]
    tip_rotation: Quaternion = PARALLEL
    gravity: Vector3 = STANDING
    bare: Arm | None = None

    @cached_property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def lower(self) -> Array:
        """Lower position limits (n,), rad."""
        return _constant([joint.lower for joint in self.joints])

    @cached_property
    def upper(self) -> Array:
        """Upper position limits (n,), rad."""
        return _constant([joint.upper for joint in self.joints])

    @cached_property
    def velocity_limits(self) -> Array:
        """Speed limits (n,), rad/s."""
        return _constant([joint.velocity_limit for joint in self.joints])

    @cached_property
    def torque_limits(self) -> Array:
        """Torque limits (n,), N m."""
        return _constant([joint.torque_limit for joint in self.joints])

    @cached_property
    def contact_links(self) -> tuple[str, ...]:
        """Names of the links that have capsules, in the order in which contact forces are reported."""
        return tuple(dict.fromkeys(self.link_names[capsule.link - 1] for capsule in self.capsules))

    @cached_property
    def task(self) -> str:
        """The task with most rows that the joints can hold, of `TASK_ROWS`; raises `SettingsError` for none."""
        # It computes with the kinematics of this module's arms.
        from contact_reach_ros.arm.kinematics import greatest_task

        return greatest_task(self)

    @cached_property
    def digest(self) -> str:
        """Fingerprint of everything that models are built from, the same on every machine."""
        values = dataclasses.asdict(dataclasses.replace(self, bare=None))
        del values["defaults"], values["bare"]
        for capsule in (*values["base_capsules"], *values["capsules"]):
            del capsule["name"]
        if len(values["base_capsules"]) == 1:
            # Bags from before there were several have the same digest.
            (values["base_capsule"],) = values.pop("base_capsules")
        if self.tip_rotation == PARALLEL:
            # Bags from before there was a rotation have the same digest.
            del values["tip_rotation"]
        if self.gravity == STANDING:
            del values["gravity"]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]

    def inertias(self, inertia_set: str = "nominal") -> tuple[Inertia, ...]:
        """Inertial parameters of the links.

        Raises `SettingsError` if there is no such set; the message lists the available ones.
        """
        try:
            return self.inertia_sets[inertia_set]
        except KeyError:
            known = ", ".join(self.inertia_sets)
            raise SettingsError(f"inertia set '{inertia_set}' is unknown; expected one of {known}") from None

    def with_center_shifts(self, x: Sequence[float], y: Sequence[float]) -> Arm:
        """The same arm with the centres of mass of all links moved in the frame of their link, (n,) m each.

        A link keeps its mass and its inertia about the centre, so that the mass matrix stays positive definite. Shifts
        in x and y are enough for any error of the weights: what the joints feel of a mass on or along the axis of the
        next joint, they feel of a shift of the link before it.
        """
        if not (any(x) or any(y)):
            return self

        def shifted(inertia: Inertia, dx: float, dy: float) -> Inertia:
            cx, cy, cz = inertia.center
            return dataclasses.replace(inertia, center=(cx + dx, cy + dy, cz))

        sets = {name: tuple(map(shifted, inertias, x, y)) for name, inertias in self.inertia_sets.items()}
        return dataclasses.replace(self, inertia_sets=sets)

    def default(self, setting: str) -> tuple[float, ...]:
        """Default of a setting with one value per joint."""
        return self.defaults.get(setting, (0.0,) * self.n)

    def with_tool(self, tool: Tool) -> Arm:
        """The arm with a tool at its tip, in every model: its weight on the last link, its tip as the tip, its shape.

        Without a tool it is the same arm; a tool on a tool is mounted at the first one's tip.
        """
        # It composes values of this module.
        from contact_reach_ros.arm.tool import attach

        return attach(self, tool)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Arm) and (self is other or self.digest == other.digest)

    def __hash__(self) -> int:
        return hash(self.digest)


def checked_array(name: str, values: object, shape: tuple[int, ...]) -> Array:
    """Return a read-only copy of `values` with the expected shape.

    Raises `InputError` if they are no numbers, the shape differs or one is not finite; the message starts with `name`.
    """
    array = np.array(values)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name}: expected numbers, got {values!r}")
    array = array.astype(float)
    if array.shape != shape:
        raise InputError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite values, got {array.ravel().tolist()}")
    array.setflags(write=False)
    return array


def _constant(values: list[float]) -> Array:
    array = np.array(values)
    array.setflags(write=False)
    return array
