"""The observer's settings after an identification of an arm that differs from its model."""

from __future__ import annotations

import dataclasses
import functools

from benchmarks.free_motion import FreeMotion
from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.tool import NO_TOOL
from contact_reach_ros.identification.identify import identify
from contact_reach_ros.identification.recording import Recording, recording_of
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.settings import MomentumSettings, ObserverSettings
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings

RECORDED_S = 90.0
_SEED = 10_001
"""Of the recorded motion: none that free motion is measured with."""


def of_arm(mismatch: MismatchSettings) -> MismatchSettings:
    """The part of a mismatch that is the arm's own, without that of obstacles."""
    foam = {name: getattr(NO_MISMATCH, name) for name in ("foam_variation", "foam_factor", "placement_error")}
    return dataclasses.replace(mismatch, **foam)


@functools.lru_cache(maxsize=4)
def identified(arm: Arm, mismatch: MismatchSettings) -> MomentumSettings:
    """The observer's settings after `contact-reach identify` on an arm that differs from its model.

    What it then sees of external torque is contact, and what no identification finds. An arm as in its model keeps the
    defaults.
    """
    if mismatch == NO_MISMATCH:
        return MomentumSettings()
    motion = record(arm, mismatch, _SEED)
    return identify(arm, NO_TOOL, ObserverSettings(), ContactBudget().resolve(arm), motion, links=True).momentum


def record(arm: Arm, mismatch: MismatchSettings, seed: int, seconds: float = RECORDED_S) -> Recording:
    """A free motion of an arm that differs from its model, from the hand-over on."""
    motion = FreeMotion(arm, mismatch, seed, ContactBudget())
    states = []
    for _ in range(round(seconds / TICK)):
        motion.tick()
        states.append(motion.state)
    return recording_of(states)
