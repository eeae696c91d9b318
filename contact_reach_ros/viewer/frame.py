"""One moment as shown on the page, from a bag or, gathered as it comes, from the topics of a running stack."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.messages.safety_state import SafetyState
from contact_reach_ros.messages.values import FARTHEST, goal_in, numbers
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.viewer.plots import History
from contact_reach_ros.world.spheres import Spheres


@dataclasses.dataclass(frozen=True)
class Frame:
    """One moment; unknown parts are None.

    Attributes
    ----------
    time
        Time on the robot's clock, s.
    q
        (n,) joint angles, rad.
    external_torque
        (n,), Nm.
    obstacles
        Spheres and the edges of deformable bodies.
    plan
        The newest plan; None also after a stop or the end of a goal has withdrawn it.
    forces
        True contact force on each link by its name, N; only the simulation knows them.
    goal
        (3,), m.
    safety
        Safety state by the name of the node.
    """

    time: float
    q: Array
    external_torque: Array | None = None
    obstacles: Spheres | None = None
    plan: PlanPicture | None = None
    forces: Mapping[str, float] = dataclasses.field(default_factory=dict)
    goal: Array | None = None
    safety: Mapping[str, SafetyState] = dataclasses.field(default_factory=dict)


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
    safety
        Newest safety state of each node.
    """

    def __init__(self, arm: Arm, clock: float) -> None:
        self._arm = arm
        self.history = History(arm.joint_names)
        self.safety: dict[str, SafetyState] = {}
        self._heard = clock
        self._frame = Frame(0.0, np.full(arm.n, np.nan), safety=self.safety)
        self._peak = np.nan

    def update(self, **parts: Any) -> None:
        """Take parts of the present `Frame`, by name."""
        self._frame = dataclasses.replace(self._frame, **parts)

    def on_joint_state(self, stamp_ns: int, q: Array, clock: float) -> None:
        """Take joint angles `q` (n,), rad."""
        time = stamp_ns / NANOSECONDS
        if time < self._frame.time:
            # Another run has begun: plans and contacts of the previous one are obsolete.
            self.update(plan=None, forces={}, goal=None)
        self.update(time=time, q=q)
        self._heard = clock

    def on_contacts(self, forces: Mapping[str, float], largest: float) -> None:
        """Take true contact forces by link, and the largest, N."""
        self.update(forces=forces)
        self._peak = np.fmax(largest, self._peak)

    def on_statistics(self, message: Any) -> None:
        """Take the goal of the plan in a plan/statistics message; raises `InputError` if it is too far away."""
        goal = goal_in({key: value for status in message.status for key, value in numbers(status)})
        if goal is None:
            return
        if not (np.abs(goal) < FARTHEST).all():
            raise InputError(f"plan/statistics: goal = {goal.tolist()}; expected numbers below {FARTHEST:g} m")
        self.update(goal=goal)

    def silence(self, clock: float) -> float:
        """Seconds since the last joint state."""
        return clock - self._heard

    def frame(self) -> Frame | None:
        """The present moment, None before the first joint state; plots the largest force since the last call."""
        frame = self._frame
        if np.isnan(frame.q).any():
            return None
        values = {"force": float(self._peak)}
        if frame.goal is not None:
            flange = link_frames(self._arm, frame.q)[1][-1]
            values["distance"] = 1000.0 * float(np.linalg.norm(flange - frame.goal))
        if frame.external_torque is not None:
            values |= dict(zip(self._arm.joint_names, frame.external_torque.tolist(), strict=True))
        self.history.add(frame.time, values)
        self._peak = np.nan
        return frame
