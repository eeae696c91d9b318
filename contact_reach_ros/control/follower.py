"""The reference that the law follows: the knot in force, or a pose to hold."""

from __future__ import annotations

import math

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.kernels import pose_error
from contact_reach_ros.control.references import Reference, ReferenceQueue, Way
from contact_reach_ros.control.settings import ImpedanceSettings, SupervisionSettings
from contact_reach_ros.timing import NANOSECONDS


class Follower:
    """Follows the plan in force; without one it holds the arm where it is.

    From knot to knot the reference moves within `reference_ramp`, rotations along the shortest arc. When a plan ends,
    runs out or is dropped, the hold begins at the measured pose at once, so that the arm presses no harder than it did.

    Attributes
    ----------
    queue
        Plans in force or waiting.
    reference
        What was followed last; None before `hold`.
    had_plan
        Whether a plan was followed since the last `restart`.
    """

    def __init__(self, n: int, impedance: ImpedanceSettings, limits: SupervisionSettings, period: float) -> None:
        """`n`: number of joints; `period`: between states, s."""
        self.queue = ReferenceQueue(n)
        self.reference: Reference | None = None
        self.had_plan = False
        self._rows = impedance.rows
        self._limits = limits
        self._ramp_ns = round(impedance.reference_ramp * NANOSECONDS)
        self._period_ns = round(period * NANOSECONDS)
        self._way: Way | None = None
        """To the knot to which the reference is moving, or has moved; None while a pose is held."""
        self._since_ns = 0
        """Since when the target or the hold has been in force."""

    def restart(self, model: RobotModel, q: Array, now_ns: int) -> None:
        """Forget all plans, refuse those stamped before `now_ns`, and hold the arm where it is."""
        self.queue.clear(now_ns)
        self.had_plan = False
        self._hold(model, q, now_ns)

    def follow(self, model: RobotModel, q: Array, error: Array, now_ns: int, may_follow: bool) -> Reference:
        """The reference for one tick.

        Parameters
        ----------
        model
            Updated for this state.
        q
            Joint positions (n,), rad.
        error
            Δx of the last tick, (6,), m and rad.
        now_ns
            Stamp of the joint state.
        may_follow
            Whether plans are followed at all.
        """
        knot = self.queue.select(now_ns) if may_follow else None
        too_far = "" if knot is None else self._too_far(knot, model, q, error)
        if too_far:
            self.queue.drop(f"plan dropped: {too_far}; plan from the arm's state, or raise the limit")
        if knot is None or too_far:
            if self.follows or self.reference is None:
                self._hold(model, q, now_ns)
        else:
            self.had_plan = True
            self._move_to(knot, now_ns)
        assert self.reference is not None
        return self.reference

    @property
    def follows(self) -> bool:
        """Whether the last tick followed a plan."""
        return self._way is not None

    @property
    def _target(self) -> Reference | None:
        """The knot that was followed last; None while a pose is held."""
        return None if self._way is None else self._way.end

    def held_for(self, now_ns: int) -> float:
        """Time since the last plan, s; 0 while one is followed."""
        return 0.0 if self.follows else (now_ns - self._since_ns) / NANOSECONDS

    def set_back(self, by_ns: int) -> None:
        """Take note that the clock was set back: elapsed times do not shrink with it."""
        self._since_ns -= by_ns

    def _hold(self, model: RobotModel, q: Array, now_ns: int) -> None:
        self.reference = Reference(model.position.copy(), model.rotation.copy(), q.copy())
        self._way, self._since_ns = None, now_ns

    def _move_to(self, target: Reference, now_ns: int) -> None:
        """Set the reference on the way from the last one to the knot in force; a step would jerk the arm.

        Every tick moves it, also where each has a new target: it was where the way begins a period ago.
        """
        if target is not self._target:
            self._way, self._since_ns = Way(self.reference or target, target), now_ns - self._period_ns
        elapsed_ns = now_ns - self._since_ns
        self.reference = target
        if elapsed_ns < self._ramp_ns and self._way is not None:
            self.reference = self._way.at(elapsed_ns / self._ramp_ns)

    def _too_far(self, reference: Reference, model: RobotModel, q: Array, error: Array) -> str:
        """In what the reference is out of the workspace or too far from the arm; empty when in nothing."""
        limits = self._limits
        if reference is not self._target:
            beyond = _beyond(reference.position, limits)
            if beyond:
                return beyond
            # Otherwise that of the last tick: it has been computed anyway.
            error = pose_error(model.position, model.rotation, reference.position, reference.rotation, self._rows)
        x, y, z, *turn = error.tolist()
        distance, angle = math.hypot(x, y, z), math.hypot(*turn)
        if not distance <= limits.max_position_error:
            return (
                f"x_d is {distance:.3f} m from the tip, permitted {limits.max_position_error:g} m (max_position_error)"
            )
        if not angle <= limits.max_rotation_error:
            return f"x_d is turned by {angle:.2f} rad, permitted {limits.max_rotation_error:g} rad (max_rotation_error)"
        errors = abs(reference.posture - q)
        if not float(errors.max()) <= limits.max_posture_error:
            joint = int(errors.argmax())
            name, found, permitted = model.arm.joint_names[joint], errors[joint], limits.max_posture_error
            return f"q_d is {found:.2f} rad from {name}, permitted {permitted:g} rad (max_posture_error)"
        return ""


def _beyond(position: Array, limits: SupervisionSettings) -> str:
    """In which coordinate a position (3,), m, is out of the workspace; empty when in none."""
    for axis, found, least, greatest in zip(
        "xyz", position.tolist(), limits.workspace_minimum, limits.workspace_maximum, strict=True
    ):
        if not least <= found <= greatest:
            return (
                f"{axis} of x_d is {found:.3f} m, permitted {least:g} to {greatest:g} m (workspace_minimum, "
                "workspace_maximum)"
            )
    return ""
