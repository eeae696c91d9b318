"""The state of a running stack, gathered from its topics."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arrays import Array
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.viewer.frame import Frame, SafetyStatus
from contact_reach_ros.viewer.history import History, joint_labels
from contact_reach_ros.world.spheres import Spheres

SILENCE = 2.0
"""Time without a joint state after which the banner reports it, s."""

_PLANS = 20

_SHOWN = {f"round trip {name}": f"driver/round trip {name} us" for name in ("p50", "p99")}
"""Numbers of diagnostics by the quantity that they are."""


class LiveState:
    """The newest message of each topic. Times named `clock` are those of a steady clock, s.

    Parameters
    ----------
    arm
        The arm of the stack.

    Attributes
    ----------
    history
        Quantities for the plots.
    goal
        Newest goal on the topic, (3,), m; None before the first.
    safety
        Newest safety state of each node.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._joints = joint_labels(arm.n)
        self.history = History(arm.n)
        self.goal: Array | None = None
        self.safety: dict[str, SafetyStatus] = {}
        self._since = 0.0
        self._heard: float | None = None
        self._stamp_ns = 0
        self._q: Array | None = None
        self._torque: Array | None = None
        self._obstacles: Spheres | None = None
        self._plan: PlanPicture | None = None
        self._forces: Mapping[str, float] = {}
        self._peak = np.nan
        self._plan_stamps: deque[int] = deque(maxlen=_PLANS)
        self._numbers: dict[str, float] = {}

    def start(self, clock: float) -> None:
        """Begin to expect joint states."""
        self._since = clock

    def on_joint_state(self, stamp_ns: int, q: Array, clock: float) -> None:
        """Take joint angles `q` (n,), rad."""
        if stamp_ns < self._stamp_ns:
            # Another run has begun: plans and contacts of the previous one are obsolete.
            self._plan, self._forces, self.goal = None, {}, None
            self._plan_stamps.clear()
        self._stamp_ns, self._q, self._heard = stamp_ns, q, clock

    def on_external_torque(self, torque: Array) -> None:
        """Take the external torque (n,), Nm."""
        self._torque = torque

    def on_obstacles(self, obstacles: Spheres) -> None:
        """Take the present obstacles."""
        self._obstacles = obstacles

    def on_plan(self, picture: PlanPicture | None) -> None:
        """Take the motion that the newest plan predicts; None once it is withdrawn."""
        self._plan = picture

    def on_plan_stamp(self, stamp_ns: int) -> None:
        """Take the time at which a plan takes effect."""
        self._plan_stamps.append(stamp_ns)

    def on_contacts(self, forces: Mapping[str, float], largest: float) -> None:
        """Take true contact forces by link, and the largest, N."""
        self._forces = forces
        self._peak = max(largest, self._peak) if np.isfinite(self._peak) else largest

    def on_numbers(self, numbers: Mapping[str, float]) -> None:
        """Take diagnostics by '<node>/<key>'."""
        self._numbers.update((key, numbers[key]) for key in _SHOWN.values() if key in numbers)

    def silence(self, clock: float) -> float:
        """Seconds since the last joint state."""
        return clock - (self._since if self._heard is None else self._heard)

    def frame(self) -> Frame | None:
        """The present moment, None before the first joint state; plots the largest force since the last call."""
        if self._q is None:
            return None
        time = self._stamp_ns / NANOSECONDS
        self.history.add(time, self._row())
        self._peak = np.nan
        return Frame(
            time, self._q, self._torque, self._obstacles, self._plan, self._forces, self.goal, dict(self.safety)
        )

    def _row(self) -> dict[str, float]:
        assert self._q is not None
        row: dict[str, float] = {"force": float(self._peak)}
        if self.goal is not None:
            row["distance"] = 1000.0 * float(np.linalg.norm(link_frames(self._arm, self._q)[1][-1] - self.goal))
        if self._torque is not None:
            row |= dict(zip(self._joints, self._torque.tolist(), strict=True))
        past = [stamp for stamp in self._plan_stamps if stamp <= self._stamp_ns]
        if past:
            row["plan age"] = (self._stamp_ns - max(past)) / 1e6
        for name, key in _SHOWN.items():
            row[name] = self._numbers.get(key, np.nan)
        return row
