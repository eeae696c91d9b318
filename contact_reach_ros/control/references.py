"""References: what a plan asks the controller to follow, paired, aged and looked up by time."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.timing import NANOSECONDS


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


@dataclass(frozen=True)
class PoseKnots:
    """The x_d half of a plan.

    Attributes
    ----------
    stamp_ns
        Time at which the plan takes effect.
    ends_ns
        (H,), for how long after the stamp each knot holds: knot i from ends_ns[i - 1] to ends_ns[i].
    positions, rotations
        (H, 3) m and (H, 3, 3), in the base frame.
    """

    stamp_ns: int
    ends_ns: tuple[int, ...]
    positions: Array
    rotations: Array


@dataclass(frozen=True)
class PostureKnots:
    """The q_d half of a plan: `postures` (H, n) rad, times as in `PoseKnots`."""

    stamp_ns: int
    ends_ns: tuple[int, ...]
    postures: Array


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


def _check_times(kind: str, ends_ns: tuple[int, ...], count: int) -> None:
    if count == 0 or len(ends_ns) != count:
        raise InputError(
            f"{kind}: {count} points with {len(ends_ns)} times; expected one or more of each, equally many"
        )
    if any(later <= earlier for earlier, later in zip((0, *ends_ns), ends_ns, strict=False)):
        raise InputError(f"{kind}: time_from_start {list(ends_ns)} ns; expected positive, strictly increasing times")


class ReferenceQueue:
    """Pairs the two halves of each plan by their stamp and hands out the plan in force.

    A plan takes effect at its stamp, replaces every earlier one, and is valid until its last knot ends. A half without
    a knot withdraws all plans.
    """

    _PENDING = 8

    def __init__(self, n: int, max_lead: float, max_duration: float = math.inf) -> None:
        """`n`: number of joints; `max_lead`: how far in the future a stamp may lie, s; `max_duration` of a plan, s."""
        self._n = n
        self._max_lead_ns = int(max_lead * NANOSECONDS)
        self._max_duration = max_duration
        self._poses: OrderedDict[int, PoseKnots] = OrderedDict()
        self._postures: OrderedDict[int, PostureKnots] = OrderedDict()
        self._waiting: list[References] = []
        self._not_before_ns = 0
        self.active: References | None = None
        self.accepted = 0
        """Number of complete and valid plans."""
        self.unpaired = 0
        """Number of halves dropped because the other half never came."""
        self.dropped: list[str] = []
        """Why plans in force were dropped; the reader empties it."""

    def offer_poses(self, knots: PoseKnots, now_ns: int) -> None:
        """Take the x_d half of a plan; raises `InputError` naming the field if it is refused."""
        count = len(knots.positions)
        if count == 0 and not knots.ends_ns:
            return self.forget()
        _check_times("reference/pose", knots.ends_ns, count)
        if knots.positions.shape[1:] != (3,) or knots.rotations.shape != (count, 3, 3):
            raise InputError("reference/pose: transforms must be one position and one rotation in each point")
        if not (np.isfinite(knots.positions).all() and np.isfinite(knots.rotations).all()):
            raise InputError(
                "reference/pose: transforms hold non-finite values; expected finite positions and rotations"
            )
        self._check_stamp("reference/pose", knots.stamp_ns, knots.ends_ns, now_ns)
        self._keep(self._poses, knots.stamp_ns, knots)
        self._pair(knots.stamp_ns, now_ns)

    def offer_postures(self, knots: PostureKnots, now_ns: int) -> None:
        """Take the q_d half of a plan; raises `InputError` naming the field if it is refused."""
        if len(knots.postures) == 0 and not knots.ends_ns:
            return self.forget()
        _check_times("reference/posture", knots.ends_ns, len(knots.postures))
        if knots.postures.shape[1:] != (self._n,) or not np.isfinite(knots.postures).all():
            raise InputError(f"reference/posture: positions must be {self._n} finite angles in each point")
        self._check_stamp("reference/posture", knots.stamp_ns, knots.ends_ns, now_ns)
        self._keep(self._postures, knots.stamp_ns, knots)
        self._pair(knots.stamp_ns, now_ns)

    def offer(self, references: References, now_ns: int) -> None:
        """Take a whole plan; raises `InputError` naming the field if it is refused."""
        stamp_ns, ends_ns = references.stamp_ns, references.ends_ns
        self.offer_poses(PoseKnots(stamp_ns, ends_ns, references.positions, references.rotations), now_ns)
        self.offer_postures(PostureKnots(stamp_ns, ends_ns, references.postures), now_ns)

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
        self._poses.clear()
        self._postures.clear()
        self._waiting.clear()
        self.active = None

    def clear(self, now_ns: int) -> None:
        """Forget all plans, and refuse those stamped before `now_ns`."""
        self.forget()
        self._not_before_ns = now_ns

    def _check_stamp(self, kind: str, stamp_ns: int, ends_ns: tuple[int, ...], now_ns: int) -> None:
        lead = stamp_ns - now_ns
        if lead > self._max_lead_ns:
            raise InputError(
                f"{kind}: header.stamp lies {lead / NANOSECONDS:.3f} s in the future; "
                f"expected at most {self._max_lead_ns / NANOSECONDS:g} s"
            )
        if ends_ns[-1] > self._max_duration * NANOSECONDS:
            raise InputError(
                f"{kind}: the plan lasts {ends_ns[-1] / NANOSECONDS:g} s; expected at most {self._max_duration:g} s"
            )
        if stamp_ns + ends_ns[-1] <= now_ns:
            late = (now_ns - stamp_ns - ends_ns[-1]) / NANOSECONDS
            raise InputError(f"{kind}: the last knot ended {late:.3f} s ago; expected a plan that is still valid")
        if stamp_ns < self._not_before_ns:
            raise InputError(f"{kind}: header.stamp is from before the last stop; expected a plan made after it")

    def _keep(self, halves: OrderedDict, stamp_ns: int, knots: PoseKnots | PostureKnots) -> None:
        halves[stamp_ns] = knots
        if len(halves) > self._PENDING:
            halves.popitem(last=False)
            self.unpaired += 1

    def _advance(self, now_ns: int) -> None:
        """Put the plan in force that took effect most recently."""
        if self.active is not None and self.active.stamp_ns > now_ns:
            # The clock was set back: that must not prolong a plan.
            self.active = None
        while self._waiting and self._waiting[0].stamp_ns <= now_ns:
            plan = self._waiting.pop(0)
            if self.active is None or plan.stamp_ns >= self.active.stamp_ns:
                self.active = plan

    def _pair(self, stamp_ns: int, now_ns: int) -> None:
        if stamp_ns not in self._poses or stamp_ns not in self._postures:
            return
        poses, postures = self._poses.pop(stamp_ns), self._postures.pop(stamp_ns)
        if poses.ends_ns != postures.ends_ns:
            raise InputError("reference/pose and reference/posture of one stamp have different time_from_start")
        positions, rotations = np.asarray(poses.positions, float), np.asarray(poses.rotations, float)
        joints = np.asarray(postures.postures, float)
        self._waiting.append(References(stamp_ns, poses.ends_ns, positions, rotations, joints))
        self._waiting.sort(key=lambda plan: plan.stamp_ns)
        self.accepted += 1
        # Also here, or plans would pile up while nobody selects, as during a stop.
        self._advance(now_ns)
