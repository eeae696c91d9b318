"""Plans as the controller sees them: paired, aged and looked up by time."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from contact_reach_ros.control.law import Reference
from contact_reach_ros.errors import InputError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseKnots:
    """The x_d half of a plan.

    Attributes
    ----------
    stamp_ns
        When the plan takes effect.
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
    """The q_d half of a plan: `postures` (H, 7) rad, times as in `PoseKnots`."""

    stamp_ns: int
    ends_ns: tuple[int, ...]
    postures: Array


@dataclass(frozen=True)
class TimedReferences:
    """One complete plan: reference i holds until stamp_ns + ends_ns[i], the whole until the last of these."""

    stamp_ns: int
    ends_ns: tuple[int, ...]
    references: tuple[Reference, ...]

    @property
    def expiry_ns(self) -> int:
        """When the last knot ends."""
        return self.stamp_ns + self.ends_ns[-1]

    def at(self, now_ns: int) -> Reference:
        """The reference in force; the last one from the expiry on."""
        elapsed = now_ns - self.stamp_ns
        for end, reference in zip(self.ends_ns, self.references, strict=True):
            if elapsed < end:
                return reference
        return self.references[-1]


def _check_times(kind: str, ends_ns: tuple[int, ...], count: int) -> None:
    if count == 0 or len(ends_ns) != count:
        raise InputError(
            f"{kind}: {count} points with {len(ends_ns)} times; expected one or more of each, equally many"
        )
    if any(later <= earlier for earlier, later in zip((0, *ends_ns), ends_ns, strict=False)):
        raise InputError(f"{kind}: time_from_start {list(ends_ns)} ns; expected positive, strictly increasing times")


class ReferenceQueue:
    """Pairs the two halves of each plan by their stamp and hands out the plan in force.

    A plan takes effect at its stamp, replaces every earlier one, and is valid until its last knot ends.
    """

    _PENDING = 8

    def __init__(self, max_lead: float) -> None:
        """`max_lead`: seconds into the future that a stamp may lie."""
        self._max_lead_ns = int(max_lead * NANOSECONDS)
        self._poses: OrderedDict[int, PoseKnots] = OrderedDict()
        self._postures: OrderedDict[int, PostureKnots] = OrderedDict()
        self._waiting: list[TimedReferences] = []
        self._not_before_ns = 0
        self.active: TimedReferences | None = None
        self.accepted = 0
        """Number of plans that were complete and valid."""
        self.unpaired = 0
        """Halves that were dropped because the other half never came."""

    def offer_poses(self, knots: PoseKnots, now_ns: int) -> None:
        """Take the x_d half of a plan; raises `InputError` naming the field if it is refused."""
        count = len(knots.positions)
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
        _check_times("reference/posture", knots.ends_ns, len(knots.postures))
        if knots.postures.shape[1:] != (iiwa14.N_JOINTS,) or not np.isfinite(knots.postures).all():
            raise InputError("reference/posture: positions must be 7 finite angles in each point")
        self._check_stamp("reference/posture", knots.stamp_ns, knots.ends_ns, now_ns)
        self._keep(self._postures, knots.stamp_ns, knots)
        self._pair(knots.stamp_ns, now_ns)

    def select(self, now_ns: int) -> Reference | None:
        """The reference in force, or None when there is no valid plan."""
        self._advance(now_ns)
        if self.active is None or now_ns >= self.active.expiry_ns:
            return None
        return self.active.at(now_ns)

    def age(self, now_ns: int) -> float:
        """Seconds since the plan last in force took effect; NaN if there was none."""
        return float("nan") if self.active is None else (now_ns - self.active.stamp_ns) / NANOSECONDS

    def clear(self, now_ns: int) -> None:
        """Forget all plans, and refuse those stamped before `now_ns`."""
        self._poses.clear()
        self._postures.clear()
        self._waiting.clear()
        self.active = None
        self._not_before_ns = now_ns

    def _check_stamp(self, kind: str, stamp_ns: int, ends_ns: tuple[int, ...], now_ns: int) -> None:
        lead = stamp_ns - now_ns
        if lead > self._max_lead_ns:
            raise InputError(
                f"{kind}: header.stamp lies {lead / NANOSECONDS:.3f} s in the future; "
                f"expected at most {self._max_lead_ns / NANOSECONDS:g} s"
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
        """Put the plan in force that took effect last."""
        if self.active is not None and self.active.stamp_ns > now_ns:
            # The clock was set back: a plan may not live longer for that.
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
        knots = (np.asarray(values, float) for values in (poses.positions, poses.rotations, postures.postures))
        references = tuple(map(Reference, *knots))
        self._waiting.append(TimedReferences(stamp_ns, poses.ends_ns, references))
        self._waiting.sort(key=lambda plan: plan.stamp_ns)
        self.accepted += 1
        # Here too, or plans would pile up while nobody selects, as in a stop.
        self._advance(now_ns)


def blend(start: Reference, end: Reference, share: float) -> Reference:
    """The reference at `share` (0 to 1) of the way from `start` to `end`, rotations along the shortest arc."""
    turn = pin.exp3(share * pin.log3(end.rotation @ start.rotation.T))
    return Reference(
        position=start.position + share * (end.position - start.position),
        rotation=turn @ start.rotation,
        posture=start.posture + share * (end.posture - start.posture),
    )
