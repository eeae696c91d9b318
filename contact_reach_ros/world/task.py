"""Tasks of the arm."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.world.goal import Target, make_goal
from contact_reach_ros.world.orientations import FREE, HOLD, POSE

TOLERANCE, ANGLE_TOLERANCE, REST_SPEED = 0.01, 0.05, 0.01
"""What counts as there and at rest by default: m, rad and m/s."""


@runtime_checkable
class Task(Protocol):
    """What `Stack.run` and the planner need from a task: a pose to plan for, and whether it is done."""

    def resolve(self, arm: Arm, present_rotation: Array) -> Target:
        """The pose to plan for, given the tip's present rotation (3, 3); raises `InputError` if it is impossible."""

    def reached(self, position: Array, target: Target) -> bool:
        """Whether the tip at `position` (3,), m, base frame, has completed the task."""

    def settled(self, position: Array, rotation: Array, speed: float, target: Target) -> bool:
        """Whether the tip in a pose, base frame, at `speed`, m/s, has completed the task and is at rest."""


@dataclass(frozen=True, eq=False)
class Goal:
    """The task of moving the tip to a pose.

    Attributes
    ----------
    position
        (3,), m.
    orientation
        'hold' for the orientation that the tip has when the goal is given, 'free' for any, or a unit quaternion
        (x, y, z, w).
    frame
        Frame of position and orientation: the arm's base frame, which an empty name stands for, too.
    tolerance
        Distance from the position that counts as reached, m.
    angle_tolerance
        Angle from the orientation with which the tip has settled, rad, unless any will do.
    rest_speed
        Speed of the tip up to which it is at rest, m/s.
    """

    position: ArrayLike
    orientation: str | ArrayLike = HOLD
    frame: str = field(default="", kw_only=True)
    tolerance: float = field(default=TOLERANCE, kw_only=True)
    angle_tolerance: float = field(default=ANGLE_TOLERANCE, kw_only=True)
    rest_speed: float = field(default=REST_SPEED, kw_only=True)

    def __post_init__(self) -> None:
        """Check everything that does not depend on the arm.

        Raises
        ------
        InputError
            If position, orientation or tolerance has the wrong type or shape.
        """
        _check_numbers("position", self.position, 3, "three numbers x, y, z in m")
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
        """The pose to plan for, given the tip's present rotation (3, 3).

        Raises
        ------
        InputError
            If a value is not finite or not a unit quaternion, the frame is unknown, or the position is out of reach or
            inside the base; the message names the field and the expectation.
        """
        named = isinstance(self.orientation, str)
        orientation = str(self.orientation) if named else POSE
        quaternion = np.zeros(4) if named else np.array(self.orientation, dtype=float)
        position = np.array(self.position, dtype=float)
        return make_goal(arm, self.frame or arm.base_frame, position, quaternion, orientation, present_rotation)

    def reached(self, position: Array, target: Target) -> bool:
        """Whether the tip at `position` (3,), m, base frame, is where `target` asks it to be."""
        return float(np.linalg.norm(position - target.position)) <= self.tolerance

    def settled(self, position: Array, rotation: Array, speed: float, target: Target) -> bool:
        """Whether the tip in a pose, base frame, at `speed`, m/s, is where `target` asks it to be, and at rest."""
        is_there = speed <= self.rest_speed and self.reached(position, target)
        return is_there and target.angle(rotation) <= self.angle_tolerance


def _check_numbers(name: str, values: ArrayLike, count: int, expected: str) -> None:
    """Raise `InputError` unless there are exactly `count` numbers, finite or not."""
    try:
        fits = np.asarray(values, dtype=float).shape == (count,)
    except (TypeError, ValueError):
        fits = False
    if not fits:
        shown = " ".join(repr(values).split())
        raise InputError(f"goal: {name} = {shown}; expected {expected}")
