"""References: what a plan asks the controller to follow, aged and looked up by time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.timing import NANOSECONDS

MAX_PLAN_LEAD = 1.0
"""Time in the future above which the stamp of a plan is refused, s: such a stamp is from another clock."""
MAX_PLAN_DURATION = 1.0
"""Duration above which a plan is refused, s: the arm would follow a planner that is gone."""


class Reference(NamedTuple):
    """Where the arm is pulled: flange pose x_d in the base frame and joint posture q_d.

    Attributes
    ----------
    position
        (3,), m.
    rotation
        (3, 3).
    posture
        (n,), rad. All zeros makes law (2) the reference-posture law (6).
    """

    position: Array
    rotation: Array
    posture: Array


class Way:
    """The way from one reference to another: straight, rotations along the shortest arc."""

    def __init__(self, start: Reference, end: Reference) -> None:
        """From `start` to `end`."""
        self.start, self.end = start, end
        self._from, self._to = pin.Quaternion(start.rotation), pin.Quaternion(end.rotation)

    def __reduce__(self) -> tuple[type[Way], tuple[Reference, Reference]]:
        # Pinocchio's quaternions cannot be copied.
        return Way, (self.start, self.end)

    def at(self, share: float) -> Reference:
        """The reference at `share` (0 to 1) of the way."""
        start, end = self.start, self.end
        return Reference(
            position=start.position + share * (end.position - start.position),
            rotation=self._from.slerp(share, self._to).matrix(),
            posture=start.posture + share * (end.posture - start.posture),
        )


@dataclass(frozen=True, eq=False)
class References:
    """The references of one plan: knot i is in force from ends_ns[i - 1] to ends_ns[i] after the stamp.

    Attributes
    ----------
    stamp_ns
        When the first knot takes effect, on the clock of the joint states, ns.
    ends_ns
        (H,), positive and increasing, ns.
    positions, rotations
        x_d, (H, 3) m and (H, 3, 3), tip in the base frame.
    postures
        q_d, (H, n), rad.
    """

    stamp_ns: int
    ends_ns: tuple[int, ...]
    positions: Array
    rotations: Array
    postures: Array

    def check(self, n: int) -> None:
        """Raise `InputError`, naming the topic and the field, unless these are references for `n` joints."""
        count, ends_ns = len(self.ends_ns), self.ends_ns
        if count == 0 or any(later <= earlier for earlier, later in zip((0, *ends_ns), ends_ns, strict=False)):
            raise InputError(
                f"reference/pose: time_from_start {list(ends_ns)} ns; expected positive, strictly increasing times"
            )
        for field, values, shape in (
            ("reference/pose: positions", self.positions, (count, 3)),
            ("reference/pose: rotations", self.rotations, (count, 3, 3)),
            ("reference/posture: positions", self.postures, (count, n)),
        ):
            if values.shape != shape:
                raise InputError(f"{field} have shape {values.shape}; expected {shape}, one for each point")
            if not np.isfinite(values).all():
                raise InputError(f"{field} hold non-finite values; expected finite ones")

    @property
    def expiry_ns(self) -> int:
        """Time at which the last knot ends."""
        return self.stamp_ns + self.ends_ns[-1]

    @cached_property
    def knots(self) -> tuple[Reference, ...]:
        """The references of the knots, in order."""
        return tuple(map(Reference, self.positions, self.rotations, self.postures))

    def at(self, time_ns: int) -> Reference:
        """The reference in force at a time after the stamp; the last one from the expiry on."""
        elapsed, knot = time_ns - self.stamp_ns, 0
        while knot < len(self.ends_ns) - 1 and elapsed >= self.ends_ns[knot]:
            knot += 1
        return self.knots[knot]


class ReferenceQueue:
    """Keeps plans until they take effect, and hands out the one in force.

    A plan takes effect at its stamp, replaces every earlier one, and is valid until its last knot ends.

    Attributes
    ----------
    active
        The plan that took effect last; None before the first, and when plans are forgotten.
    accepted
        Number of valid plans.
    dropped
        Why plans in force were dropped; the reader empties it.
    """

    def __init__(self, n: int) -> None:
        """`n`: number of joints."""
        self.active: References | None = None
        self.accepted = 0
        self.dropped: list[str] = []
        self._n = n
        self._waiting: list[References] = []
        self._not_before_ns = 0

    def offer(self, plan: References, now_ns: int) -> None:
        """Take a plan; raises `InputError` naming the field if it is refused.

        `now_ns` is the stamp of the last joint state, 0 before the first.
        """
        plan.check(self._n)
        lead, duration = (plan.stamp_ns - now_ns) / NANOSECONDS, plan.ends_ns[-1] / NANOSECONDS
        if lead > MAX_PLAN_LEAD:
            if not now_ns:
                raise InputError("reference/pose: there is no joint state yet; expected the first one before any plan")
            raise InputError(
                f"reference/pose: header.stamp lies {lead:.3f} s in the future; expected at most {MAX_PLAN_LEAD:g} s"
            )
        if duration > MAX_PLAN_DURATION:
            raise InputError(f"reference/pose: the plan lasts {duration:g} s; expected at most {MAX_PLAN_DURATION:g} s")
        if plan.expiry_ns <= now_ns:
            late = -lead - duration
            raise InputError(
                f"reference/pose: the last knot ended {late:.3f} s ago; expected a plan that is still valid"
            )
        if plan.stamp_ns < self._not_before_ns:
            raise InputError("reference/pose: header.stamp is from before the last stop; expected a plan made after it")
        self._waiting = sorted([*self._waiting, plan], key=lambda waiting: waiting.stamp_ns)
        self.accepted += 1
        # Also here, or plans would pile up while nobody selects, as during a stop.
        self._advance(now_ns)

    def select(self, now_ns: int) -> Reference | None:
        """The reference in force, or None when there is no valid plan."""
        self._advance(now_ns)
        if self.active is None or now_ns >= self.active.expiry_ns:
            return None
        return self.active.at(now_ns)

    def age(self, now_ns: int) -> float:
        """Seconds since the plan last in force took effect; NaN if there was none."""
        return float("nan") if self.active is None else (now_ns - self.active.stamp_ns) / NANOSECONDS

    def drop(self, reason: str) -> None:
        """Forget the plan in force and those that wait, for a reason."""
        self.dropped.append(reason)
        self.forget()

    def forget(self) -> None:
        """Forget all plans."""
        self._waiting, self.active = [], None

    def clear(self, now_ns: int) -> None:
        """Forget all plans, and refuse those stamped before `now_ns`."""
        self.forget()
        self._not_before_ns = now_ns

    def _advance(self, now_ns: int) -> None:
        """Put the plan in force that took effect most recently."""
        if self.active is not None and self.active.stamp_ns > now_ns:
            # The clock was set back: that must not prolong a plan.
            self.active = None
        while self._waiting and self._waiting[0].stamp_ns <= now_ns:
            plan = self._waiting.pop(0)
            if self.active is None or plan.stamp_ns >= self.active.stamp_ns:
                self.active = plan
