"""Pushes that grow slowly: how hard they are when the observer sees them, at rest and in motion."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.experiments.free_motion import REACH, START, FreeMotion
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.world.scene import MismatchSettings

RAMPS = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2)
"""Growth of the torque, Nm/s."""
PERMITTED_SHARE = 1.5
"""A push is to be seen before this share of the permitted force."""

_POSTURES = 400
"""Drawn for the longest lever of a joint."""


@dataclasses.dataclass(frozen=True)
class SlowPushes:
    """Pushes on one joint.

    Attributes
    ----------
    joint
        Its name.
    limit
        Torque before which they should be seen, Nm.
    seen_at
        Torque at which each of `RAMPS` was seen, Nm; NaN if it was not before the limit.
    """

    joint: str
    limit: float
    seen_at: tuple[float, ...]

    @property
    def slowest(self) -> float:
        """The slowest ramp that was seen, as were all faster ones, Nm/s; NaN without any."""
        slowest = math.nan
        for ramp, torque in zip(RAMPS, self.seen_at, strict=True):
            if math.isnan(torque):
                break
            slowest = ramp
        return slowest


def push_slowly(
    arm: Arm,
    budget: ContactBudget,
    moves: bool,
    settings: ObserverSettings,
    mismatch: MismatchSettings,
) -> list[SlowPushes]:
    """Push each joint on which a force at the flange has a lever, of an arm at rest or one that moves."""
    found = []
    for joint, lever in enumerate(longest_levers(arm)):
        limit = PERMITTED_SHARE * budget.permitted_force * lever
        if limit < budget.resolve(arm).contact_thresholds[joint]:
            continue
        seen_at = []
        for ramp in RAMPS:
            motion = FreeMotion(arm, mismatch, joint, budget, TICK, settings, moves)
            seen_at.append(_push(motion, joint, ramp, limit))
        found.append(SlowPushes(arm.joint_names[joint], limit, tuple(seen_at)))
    return found


def longest_levers(arm: Arm) -> list[float]:
    """Longest lever (n,) m that the flange has about each joint where arms work."""
    model, random = RobotModel(arm), np.random.default_rng(0)
    home, reach = np.array(arm.home), np.resize(REACH, arm.n)
    levers = np.zeros(arm.n)
    for _ in range(_POSTURES):
        model.update(home + random.uniform(-reach, reach), np.zeros(arm.n))
        levers = np.maximum(levers, np.linalg.norm(model.jacobian[:3], axis=0))
    return [float(lever) for lever in levers]


def _push(motion: FreeMotion, joint: int, ramp: float, limit: float) -> float:
    """The torque on a joint at which a contact is reported, Nm; NaN if it is not before the limit."""
    plant, monitor = motion.plant, motion.monitor
    while plant.time < START:
        motion.tick()
    torque = 0.0
    while torque < limit and not motion.controller_stopped:
        torque += ramp * TICK
        _apply(motion, joint, torque)
        motion.tick()
        if monitor.in_contact or monitor.stopped:
            return torque
    return math.nan


def _apply(motion: FreeMotion, joint: int, torque: float) -> None:
    """Twist a link against the one before it."""
    model, data, arm = motion.plant.model, motion.plant.data, motion.plant.scene.arm
    moment = torque * data.xaxis[joint]
    data.xfrc_applied[model.body(arm.link_names[joint]).id, 3:] = moment
    if joint:
        data.xfrc_applied[model.body(arm.link_names[joint - 1]).id, 3:] = -moment


def as_report(pushes: Sequence[SlowPushes]) -> dict[str, dict[str, object]]:
    """For JSON, by joint."""
    return {
        each.joint: {
            "limit_nm": each.limit,
            "seen_at_nm": dict(zip(map(str, RAMPS), each.seen_at, strict=True)),
            "slowest_nm_per_s": each.slowest,
        }
        for each in pushes
    }


def as_table(pushes: Sequence[SlowPushes]) -> str:
    """A line per joint."""
    head = f"  joint   limit  slowest   seen at, Nm, growing by {'  '.join(f'{ramp:5g}' for ramp in RAMPS)} Nm/s"
    lines = [
        f"  {each.joint:7s} {each.limit:5.1f}  {each.slowest:7.2g}{'':26s}"
        + "  ".join(f"{torque:5.1f}" for torque in each.seen_at)
        for each in pushes
    ]
    return "\n".join([head, *lines])
