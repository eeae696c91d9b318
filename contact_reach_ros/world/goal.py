"""Goals of the arm: the tasks that users give, and the poses of the flange that are planned for."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm import Arm, Array, checked_array, rotation_from_quaternion
from contact_reach_ros.arm.kinematics import AXIS, POSITION
from contact_reach_ros.errors import InputError

HOLD, POSE, FREE = ORIENTATIONS = ("hold", "pose", "free")
"""Orientation of a goal: the present one when the first of successive goals is given, that of a commanded pose, or
any."""

TOLERANCE, ANGLE_TOLERANCE, REST_SPEED = 0.01, 0.05, 0.01
"""Default tolerances of a goal: m, rad and m/s."""

_NEAR_POSITION, _NEAR_ROTATION = 0.02, 0.1
"""Differences up to which a search for plans goes on with another target, m and rad."""


@dataclass(frozen=True)
class Target:
    """Pose that the flange has to reach, in the base frame.

    Raises
    ------
    InputError
        If a value is not finite, has the wrong shape, or the rotation is not a rotation matrix.
    """

    position: Array
    """(3,), m."""
    rotation: Array | None = None
    """(3, 3), or None to leave the orientation free."""
    only_axis: bool = False
    """Whether only the direction of its z axis counts, about which the flange may be turned as it likes."""
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    """(3,), m/s, with which the position moves."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checked_array("goal position", self.position, (3,)))
        object.__setattr__(self, "velocity", checked_array("goal velocity", self.velocity, (3,)))
        if self.rotation is not None:
            rotation = checked_array("goal rotation", self.rotation, (3, 3))
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0.0:
                raise InputError(
                    "goal rotation: expected an orthonormal, right-handed matrix; normalise its quaternion"
                )
            object.__setattr__(self, "rotation", rotation)

    def angle(self, rotation: Array) -> float:
        """Angle from an orientation (3, 3) to the target's, or between the z axes, rad; 0 where any will do."""
        if self.rotation is None:
            return 0.0
        # ‖R - R'‖ / √2 is 2 sin(angle / 2), and so is ‖z - z'‖.
        error, most = (self.rotation - rotation)[:, 2 if self.only_axis else slice(None)], 2.0 * math.sqrt(2.0)
        return 2.0 * math.asin(min(1.0, float(np.linalg.norm(error)) / (2.0 if self.only_axis else most)))

    def of_task(self, task: str) -> Target:
        """The target without what a task, of `TASK_ROWS`, does not control of the orientation."""
        if task == POSITION:
            return replace(self, rotation=None)
        return replace(self, only_axis=self.rotation is not None) if task == AXIS else self

    @property
    def moves(self) -> bool:
        """Whether it has a velocity."""
        return bool(self.velocity.any())

    def is_near(self, other: Target | None, distance: float = _NEAR_POSITION) -> bool:
        """Whether both ask for nearly the same pose, to `distance`, m, so that what leads to one leads to the other."""
        if other is None or (self.rotation is None) != (other.rotation is None) or self.only_axis != other.only_axis:
            return False
        turned = 0.0 if other.rotation is None else self.angle(other.rotation)
        return turned <= _NEAR_ROTATION and math.dist(self.position, other.position) <= distance


@runtime_checkable
class Task(Protocol):
    """The interface of tasks to `Stack.run` and the planner: a pose to plan for, and whether the task is done."""

    def resolve(self, arm: Arm, present_rotation: Array) -> Target:
        """The pose to plan for, given the tip's present rotation (3, 3); raises `InputError` if it is impossible."""

    def reached(self, position: Array, target: Target) -> bool:
        """Whether the tip at `position` (3,), m, base frame, has completed the task."""

    def settled(self, position: Array, rotation: Array, speed: float, target: Target) -> bool:
        """Whether the tip in a pose, base frame, at `speed`, m/s, has completed the task and is at rest."""


@dataclass(frozen=True, eq=False)
class Goal:
    """The task of moving the tip to a pose.

    Raises
    ------
    InputError
        If position, orientation or tolerance has the wrong type or shape, or a value is not finite.
    """

    position: ArrayLike
    """(3,), m, base frame."""
    orientation: str | ArrayLike = HOLD
    """'hold' for the orientation that the tip has when the goal is given, 'free' for any, which is held once the tip
    is there, or a unit quaternion (x, y, z, w)."""
    tolerance: float = field(default=TOLERANCE, kw_only=True)
    """Distance from the position that counts as reached, m."""
    angle_tolerance: float = field(default=ANGLE_TOLERANCE, kw_only=True)
    """Angle from the orientation with which the tip has settled, rad, unless any will do."""
    rest_speed: float = field(default=REST_SPEED, kw_only=True)
    """Speed of the tip up to which it is at rest, m/s."""

    def __post_init__(self) -> None:
        _check_numbers("position", self.position, 3, "three finite numbers x, y, z in m")
        expected = f"'{HOLD}', '{FREE}' or a unit quaternion x, y, z, w"
        if not isinstance(self.orientation, str):
            _check_numbers("orientation", self.orientation, 4, expected)
        elif self.orientation not in (HOLD, FREE):
            raise InputError(f"goal: orientation = '{self.orientation}'; expected {expected}")
        for name, what in (
            ("tolerance", "distance in m"),
            ("angle_tolerance", "angle in rad"),
            ("rest_speed", "speed in m/s"),
        ):
            if not getattr(self, name) > 0.0:
                raise InputError(f"goal: {name} = {getattr(self, name)}; expected a positive {what}")

    def resolve(self, arm: Arm, present_rotation: Array) -> Target:
        """The pose to plan for, as far as the arm can hold it, given the tip's present rotation (3, 3).

        Raises
        ------
        InputError
            If the orientation is no unit quaternion, or the position is out of reach; the message names the field and
            the expectation.
        """
        position = np.array(self.position, dtype=float)
        distance = math.dist(position.tolist(), arm.shoulder)
        if distance > arm.reach:
            raise InputError(
                f"goal: position is {distance:.4g} m from the shoulder at {list(arm.shoulder)} m; the arm reaches "
                f"{arm.reach} m"
            )
        if isinstance(self.orientation, str):
            return Target(position, present_rotation if self.orientation == HOLD else None).of_task(arm.task)
        quaternion = np.array(self.orientation, dtype=float)
        length = float(np.linalg.norm(quaternion))
        if not abs(length - 1.0) < 0.01:
            raise InputError(f"goal: orientation = {quaternion.tolist()}; expected a unit quaternion x, y, z, w")
        return Target(position, rotation_from_quaternion(np.roll(quaternion, 1))).of_task(arm.task)

    def reached(self, position: Array, target: Target) -> bool:
        """Whether the tip at `position` (3,), m, base frame, is where `target` asks it to be."""
        return float(np.linalg.norm(position - target.position)) <= self.tolerance

    def settled(self, position: Array, rotation: Array, speed: float, target: Target) -> bool:
        """Whether the tip in a pose, base frame, at `speed`, m/s, is where `target` asks it to be, and at rest."""
        is_there = speed <= self.rest_speed and self.reached(position, target)
        return is_there and target.angle(rotation) <= self.angle_tolerance


def _check_numbers(name: str, values: ArrayLike, count: int, expected: str) -> None:
    """Raise `InputError` unless there are exactly `count` finite numbers."""
    try:
        array = np.asarray(values, dtype=float)
        fits = array.shape == (count,) and np.isfinite(array).all()
    except (TypeError, ValueError):
        fits = False
    if not fits:
        shown = " ".join(repr(values).split())
        raise InputError(f"goal: {name} = {shown}; expected {expected}")
