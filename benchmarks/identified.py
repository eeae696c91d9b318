"""What identification is worth: payload, external torque and the pushes that are seen, before it and after it."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np

from benchmarks.free_motion import FreeMotion
from benchmarks.observer_trials import SCALES, least_push, move_freely, push_often
from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.mjcf import PAYLOAD_CENTER
from contact_reach_ros.arm.tool import NO_TOOL
from contact_reach_ros.identification.identify import BOTH, LINKS, TOOL, Identification, identify
from contact_reach_ros.identification.output import describe
from contact_reach_ros.identification.recording import Recording, recording_of
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.settings import MomentumSettings, ObserverSettings
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings

PUSH = 50.0
"""N, on links at mid-arm."""
RECORDED_S = 90.0
_SEEDS = (10_001, 10_002, 10_003)
"""Of the recorded motions: none that free motion is measured with."""


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
    motion = record(arm, mismatch, _SEEDS[0])
    return identify(arm, NO_TOOL, ObserverSettings(), ContactBudget().resolve(arm), [motion], LINKS).momentum


def compare(
    arm: Arm, mismatch: MismatchSettings, budget: ContactBudget, settings: ObserverSettings, minutes: float, pushes: int
) -> dict[str, Any]:
    """Identify an arm that differs from its model, print and return what the observer sees before and after.

    Parameters
    ----------
    arm, mismatch
        The model, and how the simulated arm differs.
    budget, settings
        Of the observer, before.
    minutes
        Of free motion, before and after, in which contacts and stops are false.
    pushes
        How many, before and after.
    """
    loaded = record(arm, mismatch, _SEEDS[0])
    bare = record(arm, dataclasses.replace(mismatch, payload=0.0), _SEEDS[1])
    right = record(arm, dataclasses.replace(mismatch, inertia_set="nominal"), _SEEDS[2])
    found = identify(arm, NO_TOOL, settings, budget, [loaded], LINKS)
    print(describe(found, arm, budget))
    payloads = {
        "links as in the model": _payload(identify(arm, NO_TOOL, settings, budget, [right], TOOL)),
        "other links, a motion without payload": _payload(
            identify(arm, NO_TOOL, settings, budget, [loaded], BOTH, [bare])
        ),
    }
    print(f"payload of {mismatch.payload:g} kg, {1000 * PAYLOAD_CENTER[2]:g} mm from the flange")
    for name, payload in payloads.items():
        print(
            f"  {name}: {payload['mass_kg']:.3f} ± {payload['half_width_kg']:.3f} kg, centre "
            f"{payload['center_error_mm']:.1f} mm off"
        )
    updated = dataclasses.replace(settings, momentum=found.momentum)
    report: dict[str, Any] = {"payload": payloads, "residual_rms_ratio": found.rms_ratio}
    print("least push that would be seen, N: p50  p95   free motion uses at most   false contacts, stops per hour")
    for name, thresholds, observing in (("before", budget, settings), ("after", found.budget, updated)):
        free = move_freely(arm, mismatch, minutes, thresholds, TICK, observing)
        least = least_push(push_often(arm, PUSH, pushes, thresholds, TICK, mismatch, observing), PUSH)
        per_hour = 60.0 / minutes
        used = next((scale for scale, count in zip(SCALES, free.onsets, strict=True) if not count), math.inf)
        report[name] = {
            "least_push_N": least,
            "free_rms_nm": free.rms,
            "threshold_share_used": used,
            "false_contacts_per_hour": free.contacts * per_hour,
            "false_stops_per_hour": len(free.stops) * per_hour,
            "false_stops": free.stops,
        }
        pushes_seen = f"{least['p50']:5.1f} {least['p95']:5.1f}   {100 * used:20.0f} %"
        false = f"{free.contacts * per_hour:6.1f} {len(free.stops) * per_hour:6.1f}"
        print(f"  {name:30s} {pushes_seen}   {false}", *free.stops, sep="\n")
    return report


def record(arm: Arm, mismatch: MismatchSettings, seed: int, seconds: float = RECORDED_S) -> Recording:
    """A free motion of an arm that differs from its model, from the hand-over on."""
    motion = FreeMotion(arm, mismatch, seed, ContactBudget())
    states = []
    for _ in range(round(seconds / TICK)):
        motion.tick()
        states.append(motion.state)
    return recording_of(states)


def _payload(found: Identification) -> dict[str, float]:
    assert found.tool is not None
    values, widths, _ = found.fit.of("tool")
    return {
        "mass_kg": float(values[0]),
        "half_width_kg": float(widths[0]),
        "center_error_mm": 1000.0 * float(np.linalg.norm(np.subtract(found.tool.center, PAYLOAD_CENTER))),
    }
