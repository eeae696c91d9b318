"""The state of a running stack, gathered from its topics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.messages.values import FARTHEST, goal_in, numbers
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.viewer.frame import Frame, SafetyStatus
from contact_reach_ros.viewer.plots import History
from contact_reach_ros.world.spheres import Spheres


class LiveState:
    """The newest message of each topic. Times named `clock` are those of a steady clock, s.

    Parameters
    ----------
    arm
        The arm of the stack.
    clock
        When joint states begin to be expected.

    Attributes
    ----------
    history
        Quantities for the plots.
    external_torque
        (n,), Nm; None before the first.
    obstacles
        The present obstacles; None before the first.
    plan
        Motion that the newest plan predicts; None once it is withdrawn.
    goal
        (3,), m, of the newest plan; None before the first.
    safety
        Newest safety state of each node.
    """

    def __init__(self, arm: Arm, clock: float) -> None:
        self._arm = arm
        self.history = History(arm.joint_names)
        self.external_torque: Array | None = None
        self.obstacles: Spheres | None = None
        self.plan: PlanPicture | None = None
        self.goal: Array | None = None
        self.safety: dict[str, SafetyStatus] = {}
        self._heard = clock
        self._stamp_ns = 0
        self._q: Array | None = None
        self._forces: Mapping[str, float] = {}
        self._peak = np.nan

    def on_joint_state(self, stamp_ns: int, q: Array, clock: float) -> None:
        """Take joint angles `q` (n,), rad."""
        if stamp_ns < self._stamp_ns:
            # Another run has begun: plans and contacts of the previous one are obsolete.
            self.plan, self._forces, self.goal = None, {}, None
        self._stamp_ns, self._q, self._heard = stamp_ns, q, clock

    def on_contacts(self, forces: Mapping[str, float], largest: float) -> None:
        """Take true contact forces by link, and the largest, N."""
        self._forces = forces
        self._peak = max(largest, self._peak) if np.isfinite(self._peak) else largest

    def on_statistics(self, message: Any) -> None:
        """Take the goal of the plan in a plan/statistics message; raises `InputError` if it is too far away."""
        goal = goal_in({key: value for status in message.status for key, value in numbers(status)})
        if goal is None:
            return
        if not (np.abs(goal) < FARTHEST).all():
            raise InputError(f"plan/statistics: goal = {goal.tolist()}; expected numbers below {FARTHEST:g} m")
        self.goal = goal

    def silence(self, clock: float) -> float:
        """Seconds since the last joint state."""
        return clock - self._heard

    def frame(self) -> Frame | None:
        """The present moment, None before the first joint state; plots the largest force since the last call."""
        if self._q is None:
            return None
        time = self._stamp_ns / NANOSECONDS
        values = {"force": float(self._peak)}
        if self.goal is not None:
            flange = link_frames(self._arm, self._q)[1][-1]
            values["distance"] = 1000.0 * float(np.linalg.norm(flange - self.goal))
        if self.external_torque is not None:
            values |= dict(zip(self._arm.joint_names, self.external_torque.tolist(), strict=True))
        self.history.add(time, values)
        self._peak = np.nan
        return Frame(
            time,
            self._q,
            self.external_torque,
            self.obstacles,
            self.plan,
            self._forces,
            self.goal,
            dict(self.safety),
        )
