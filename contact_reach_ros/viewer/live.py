"""What is known of a running stack, gathered from its topics."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.viewer.frame import Frame, PlanPicture, Status
from contact_reach_ros.viewer.history import JOINTS, History

Array = NDArray[np.float64]

SILENCE = 2.0
"""Time without a joint state after which the page says so, s."""

_PLANS = 20


class LiveState:
    """The newest of everything. Times `clock` are those of a steady clock, s.

    Attributes
    ----------
    history
        For the plots.
    goal
        Newest goal on the topic, (3,), m; None before one.
    safety
        Newest status by node.
    """

    def __init__(self) -> None:
        self.history = History()
        self.goal: Array | None = None
        self.safety: dict[str, Status] = {}
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
        """From now on joint states are expected."""
        self._since = clock

    def on_joint_state(self, stamp_ns: int, q: Array, clock: float) -> None:
        """The arm is at `q` (7,) rad."""
        if stamp_ns < self._stamp_ns:
            # Another run has begun: what was planned and touched before is no longer true.
            self._plan, self._forces, self.goal = None, {}, None
            self._plan_stamps.clear()
        self._stamp_ns, self._q, self._heard = stamp_ns, q, clock

    def on_external_torque(self, torque: Array) -> None:
        """The residual is `torque` (7,) Nm."""
        self._torque = torque

    def on_obstacles(self, obstacles: Spheres) -> None:
        """Obstacles as they are now."""
        self._obstacles = obstacles

    def on_plan(self, picture: PlanPicture | None) -> None:
        """What the newest plan expects; None when there is none any more."""
        self._plan = picture

    def on_plan_stamp(self, stamp_ns: int) -> None:
        """A plan takes effect, or will."""
        self._plan_stamps.append(stamp_ns)

    def on_contacts(self, forces: Mapping[str, float], largest: float) -> None:
        """True contact forces by link, and the largest, N."""
        self._forces = forces
        self._peak = max(largest, self._peak) if np.isfinite(self._peak) else largest

    def on_numbers(self, numbers: Mapping[str, float]) -> None:
        """Diagnostics by '<node>/<key>'."""
        self._numbers.update(numbers)

    def silence(self, clock: float) -> float:
        """Seconds without a joint state."""
        return clock - (self._since if self._heard is None else self._heard)

    def frame(self) -> Frame | None:
        """The moment at hand, None before the first joint state; its largest force is that since the last call."""
        if self._q is None:
            return None
        time = self._stamp_ns / NANOSECONDS
        self.history.add(time, **self._row())
        self._peak = np.nan
        return Frame(
            time, self._q, self._torque, self._obstacles, self._plan, self._forces, self.goal, dict(self.safety)
        )

    def _row(self) -> dict[str, float]:
        assert self._q is not None
        row: dict[str, float] = {"force": float(self._peak)}
        if self.goal is not None:
            row["distance"] = 1000.0 * float(np.linalg.norm(link_frames(self._q)[1][-1] - self.goal))
        if self._torque is not None:
            row |= dict(zip(JOINTS, self._torque.tolist(), strict=True))
        past = [stamp for stamp in self._plan_stamps if stamp <= self._stamp_ns]
        if past:
            row["plan_age"] = (self._stamp_ns - max(past)) / 1e6
        for name in ("p50", "p99"):
            row[f"round_trip_{name}"] = self._numbers.get(f"driver/round trip {name} us", np.nan)
        return row
