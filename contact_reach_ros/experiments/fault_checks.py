"""What an episode with faults has to be like, whatever went wrong."""

from __future__ import annotations

from enum import Enum

import numpy as np

from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.experiments.episode import EpisodeResult
from contact_reach_ros.plant.plant import TICK
from contact_reach_ros.robot import iiwa14

LASTING_FORCE = 140.0
"""Largest contact force that may last, N: what ISO/TS 15066 permits on hands, and the largest that a contact budget
accepts. The budget's thresholds keep below it where the lever arm is longer than 0.21 m: 30 Nm on A2 are
140 N there."""
TRANSIENT_FORCE = 280.0
"""Largest contact force at any time, N: twice as much, as ISO/TS 15066 permits in an impact."""
TRANSIENT_TIME = 0.5
"""How long an impact may take, s, in ISO/TS 15066."""
STILL = 0.05
"""Joint speed below which the arm is still, rad/s, as for a reset."""
SPEED_SHARE = 1.25
"""Largest joint speed as a share of the data sheet's limit: a stop at the limit needs some time to act."""


class End(Enum):
    """How an episode ends."""

    REACHED = "reached"
    """The goal was reached and nothing stopped the arm."""
    STOPPED = "stopped"
    """The arm was stopped and is still."""
    HELD = "held"
    """The arm is still, though it was not stopped."""
    MOVING = "moving"
    """Neither: it moves."""


def end_of(result: EpisodeResult) -> End:
    """How the episode ended."""
    if result.reached:
        return End.REACHED
    if not result.end_speed <= STILL:
        return End.MOVING
    return End.STOPPED if result.stop_reason else End.HELD


def speed_share(result: EpisodeResult) -> float:
    """Largest joint speed in the episode, as a share of the joint's limit."""
    if len(result.joints) < 2:
        return 0.0
    speeds = np.abs(np.diff(result.joints, axis=0)) / TICK
    return float((speeds / np.array(iiwa14.VELOCITY_LIMITS)).max())


def torque_violations(result: EpisodeResult, limits: LimitSettings) -> list[str]:
    """What is wrong with the commanded torques; NaN before the first command is none."""
    torques = result.torques
    sent = np.flatnonzero(~np.isnan(torques).all(axis=1))
    if len(sent) == 0:
        return []
    torques = torques[sent[0] :]
    if not np.isfinite(torques).all():
        return ["a commanded torque is not finite"]
    excess = np.abs(torques) / (limits.torque_share * np.array(iiwa14.TORQUE_LIMITS))
    if excess.max() > 1.0 + 1e-9:
        joint = iiwa14.JOINT_NAMES[int(excess.max(axis=0).argmax())]
        return [f"the torque on {joint} is {excess.max():.2f} times its cap"]
    return []


def force_violations(result: EpisodeResult) -> list[str]:
    """Where contact forces are above what may last, or may ever be; also a simulation that is no longer finite."""
    forces = result.contact_forces
    if not (np.isfinite(forces).all() and np.isfinite(result.joints).all()):
        return ["the simulation is not finite"]
    found = []
    if len(forces) and forces.max() > TRANSIENT_FORCE:
        found.append(f"a contact force of {forces.max():.0f} N, at most {TRANSIENT_FORCE:g} N at any time")
    longest = current = 0
    for is_above in (forces > LASTING_FORCE).tolist():
        current = current + 1 if is_above else 0
        longest = max(longest, current)
    if longest * TICK > TRANSIENT_TIME:
        found.append(f"a contact force above {LASTING_FORCE:g} N for {longest * TICK:.1f} s")
    return found
