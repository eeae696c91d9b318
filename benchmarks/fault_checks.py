"""Bounds on an episode with faults, whatever the faults are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum

import numpy as np
from scipy.ndimage import minimum_filter1d

from benchmarks.episode_result import EpisodeResult
from benchmarks.faulty_robot import Fault, Push, RivalCommands
from contact_reach_ros.arm import Arm
from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.control.controller import HELD_AFTER
from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.control.supervisor import STOP_TIME
from contact_reach_ros.simulation.plant import TICK

LASTING_FORCE = 140.0
"""Largest contact force that may last, N: what ISO/TS 15066 permits on hands, and the largest that a contact budget
accepts. The budget's thresholds stay below it where the lever arm is longer than 0.21 m: 30 Nm on A2 are
140 N there."""
TRANSIENT_FORCE = 280.0
"""Largest contact force at any time, N: twice as much, as ISO/TS 15066 permits in an impact."""
TRANSIENT_TIME = 0.5
"""How long an impact may take, s, in ISO/TS 15066."""
STILL = 0.05
"""Joint speed below which the arm is still, rad/s, as for a reset."""
LINGER = STOP_TIME + 0.5
"""How long the arm is watched after a stop, s: at its end at the latest the drive's brakes hold."""
SPEED_SHARE = 1.25
"""Largest joint speed as a share of the data sheet's limit: a stop at the limit needs some time to act."""

FORCE, LASTING, TORQUE, TORQUE_RATE, SPEED = BOUNDS = (
    "contact force",
    "lasting contact force",
    "torque",
    "torque rate",
    "joint speed",
)
MOVED_BY_OTHERS = (Push, RivalCommands)
"""Faults with which a joint's speed is not the controller's doing."""
_ROUNDING = 1e-9


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
    """Classify the end of an episode."""
    if result.reached:
        return End.REACHED
    if not result.end_speed <= STILL:
        return End.MOVING
    return End.STOPPED if result.stop_reason else End.HELD


def speed_share(result: EpisodeResult, arm: Arm) -> float:
    """Return the largest joint speed in the episode as a share of the joint's limit."""
    if len(result.joints) < 2:
        return 0.0
    speeds = np.abs(np.diff(result.joints, axis=0)) / TICK
    return float((speeds / arm.velocity_limits).max())


def bounds_used(result: EpisodeResult, limits: LimitSettings, arm: Arm, faults: Sequence[Fault]) -> dict[str, float]:
    """How much of each bound an episode came to use, as a share that is at most 1; infinite where it is not finite.

    Only what was sent counts as torque, and a change of it only from one command to the next: after 20 ms without one
    the drive holds the arm by itself, and the controller begins anew from the torque that does. Where others move the
    arm, its speed counts for nothing.
    """
    is_moved = any(isinstance(fault, MOVED_BY_OTHERS) for fault in faults)
    forces, torques = result.contact_forces, result.commands
    changes = np.abs(np.diff(torques, axis=0))[np.diff(result.command_times) <= HELD_AFTER]
    rates = torque_rates(arm, limits) * result.period
    window = round(TRANSIENT_TIME / TICK) + 1
    used = {
        FORCE: forces.max(initial=0.0) / TRANSIENT_FORCE,
        # The largest force that is exceeded for longer than an impact takes.
        LASTING: minimum_filter1d(forces, window, mode="constant").max(initial=0.0) / LASTING_FORCE,
        TORQUE: (np.abs(torques) / (limits.torque_share * arm.torque_limits)).max(initial=0.0),
        TORQUE_RATE: (changes / rates).max(initial=0.0),
        SPEED: 0.0 if is_moved else speed_share(result, arm) / SPEED_SHARE,
    }
    return {bound: float(share) if np.isfinite(share) else float("inf") for bound, share in used.items()}


def violations(used: Mapping[str, float]) -> list[str]:
    """The bounds that were exceeded, and by how much."""
    return [f"{bound}: {share:.2f} times what is permitted" for bound, share in used.items() if share > 1.0 + _ROUNDING]
