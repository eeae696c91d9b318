"""What the observer sees in free motion, and the thresholds that this permits."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.recording import Recording
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.settings import Setting
from contact_reach_ros.timing import states_in

MARGIN = 1.5
"""Of thresholds over the largest torques of free motion: a longer motion has larger ones."""


@dataclass(frozen=True, eq=False)
class Watched:
    """The observer's torques while nothing touched the arm, (n,) each.

    Attributes
    ----------
    rms
        Of the external torque, N m.
    used
        Largest share of a joint's contact threshold that its sudden external torque had for as long as a contact takes.
    mean
        Largest slow mean, N m.
    """

    rms: Array
    used: Array
    mean: Array


def watch(arm: Arm, settings: ObserverSettings, budget: ContactBudget, recording: Recording) -> Watched:
    """Let an observer see a recording.

    Raises `InputError` if the acting torque is never known for as long as a hand-over takes.
    """
    budget, period = budget.resolve(arm), recording.period
    observer = Observer(arm, settings, budget, period, locates=False)
    residuals, sudden, speeds = [], [], []
    for state in recording.states():
        observer.update(state)
        if observer.momentum.known_for >= budget.handover_time:
            residuals.append(observer.momentum.residual)
            sudden.append(observer.monitor.sudden)
            speeds.append(np.abs(state.v))
    states = states_in(settings.safety.contact_debounce, period)
    if len(residuals) < states:
        raise InputError(f"the torques are never known for {budget.handover_time:g} s: expected a longer recording")
    limits = np.array(budget.contact_thresholds) + np.array(budget.contact_per_speed) * np.array(speeds)
    shares = np.lib.stride_tricks.sliding_window_view(np.abs(sudden) / limits, states, axis=0).min(axis=-1)
    torques = np.array(residuals)
    return Watched(
        np.sqrt((torques**2).mean(axis=0)), shares.max(axis=0), np.abs(torques - np.array(sudden)).max(axis=0)
    )


def propose(arm: Arm, budget: ContactBudget, seen: Watched, dry_friction: Sequence[float]) -> ContactBudget:
    """The budget with thresholds as low as the free motion permits; none is raised.

    Those that report a contact, and the share that counts as an error of the model, keep a `MARGIN` over it. Those that
    stop the arm are lowered by as much: what they permit beyond that is the permitted force. At rest `dry_friction`
    (n,), N m, may carry any part of a weight: so much always counts as an error of the model.
    """
    budget = budget.resolve(arm)
    share = np.minimum(MARGIN * seen.used, 1.0)
    contact = _within("contact_thresholds", share * budget.contact_thresholds)
    error = np.minimum(_within("model_error", np.maximum(MARGIN * seen.mean, dry_friction)), budget.model_error)
    less, less_error = np.array(budget.contact_thresholds) - contact, np.array(budget.model_error) - error
    values = {
        "contact_thresholds": contact,
        "contact_per_speed": share * budget.contact_per_speed,
        "model_error": error,
        "sudden_thresholds": _within("sudden_thresholds", budget.sudden_thresholds - less),
        "torque_thresholds": _within("torque_thresholds", budget.torque_thresholds - less_error),
        "handover_thresholds": np.minimum(_within("handover_thresholds", error + contact), budget.handover_thresholds),
    }
    rounded: dict[str, Any] = {name: tuple(np.round(value, 2).tolist()) for name, value in values.items()}
    return dataclasses.replace(budget, **rounded)


def _within(name: str, values: Array) -> Array:
    """Values of a threshold, no smaller than the budget accepts."""
    entry: Setting = next(entry for entry in ContactBudget.declared() if entry.name == name)
    return np.maximum(values, entry.minimum or 0.0)
