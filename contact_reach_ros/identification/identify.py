"""Identification of an arm from a recording of its free motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.fit import Fit, Parameters, fit
from contact_reach_ros.identification.recording import Recording, make_samples
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.safety import HANDOVER_TIME
from contact_reach_ros.observer.settings import MomentumSettings, ObserverSettings
from contact_reach_ros.timing import states_in

_DIGITS = 5
"""Decimals of what is written."""


_LEAST, _LEAST_CONTACT = 0.5, 0.05
"""Least thresholds that are proposed, N m: those that stop the arm or are for hand-over, and those of contacts."""
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
        Largest baseline of the external torque, N m.
    """

    rms: Array
    used: Array
    mean: Array


@dataclass(frozen=True, eq=False)
class Identification:
    """What was found.

    Attributes
    ----------
    fit
        Values, intervals, and what is not identifiable.
    tool
        The tool with the mass and the centre that were found; None where it was not asked for.
    center_half_widths
        Half of the confidence interval of its centre, (3,) m; NaN where the centre is not identifiable and stays as it
        was.
    momentum
        The observer's settings with what was found.
    budget
        The contact budget with the thresholds that it permits.
    before, after
        What the observer sees of the motion with the settings it had, and with these.
    """

    fit: Fit
    tool: Tool | None
    center_half_widths: Array
    momentum: MomentumSettings
    budget: ContactBudget
    before: Watched
    after: Watched

    @property
    def rms_ratio(self) -> float:
        """The external torque of all joints together after, as a share of that before."""
        return float(np.linalg.norm(self.after.rms) / np.linalg.norm(self.before.rms))


def identify(
    arm: Arm,
    tool: Tool,
    settings: ObserverSettings,
    budget: ContactBudget,
    recording: Recording,
    links: bool = False,
) -> Identification:
    """Fit the model to a free motion, and see what the observer makes of it with it.

    Raises `InputError` if the recording does not permit it.

    Parameters
    ----------
    arm
        Without a tool.
    tool
        That the nodes had.
    settings, budget
        Of the observer, as they were.
    recording
        With the tool.
    links
        Fit the weights of the links, with the tool as the nodes had it; else the tool, with the links as they had them.
    """
    momentum, budget = settings.momentum.resolve(arm), budget.resolve(arm)
    had = arm.with_tool(tool)
    known = had if links else arm.with_center_shifts(*_shifts(momentum, arm, tool.mass, 0.0))
    parameters = Parameters(known, None if links else tool, momentum.gravity_in_torque, momentum.rotors_in_torque)
    found = fit(parameters, make_samples(recording, momentum))
    new_tool, half_widths = (None, np.full(3, np.nan)) if links else _tool(found, arm, tool)
    new = dataclasses.replace(momentum, **_values(found))
    if new_tool is not None:
        x, y = _shifts(momentum, arm, tool.mass, new_tool.mass)
        new = dataclasses.replace(new, center_shift_x=x, center_shift_y=y)
    has = had if new_tool is None else arm.with_tool(new_tool)
    before = watch(had, settings, budget, recording)
    after = watch(has, dataclasses.replace(settings, momentum=new), budget, recording)
    permitted = propose(arm, budget, after, new.coulomb_friction)
    return Identification(found, new_tool, half_widths, new, permitted, before, after)


def _values(found: Fit) -> dict[str, Any]:
    """The observer's settings that were fitted; friction that came out negative is none."""
    values = {
        "coulomb_friction": np.maximum(found.of("coulomb")[0], 0.0),
        "viscous_friction": np.maximum(found.of("viscous")[0], 0.0),
        "torque_offset": found.of("offset")[0],
    }
    for axis in "xy":
        if f"shift_{axis}" in found.parameters.slots:
            values[f"center_shift_{axis}"] = found.of(f"shift_{axis}")[0]
    return {name: _rounded(value) for name, value in values.items()}


def _shifts(momentum: MomentumSettings, arm: Arm, before: float, after: float) -> list[tuple[float, ...]]:
    """The shifts of the links' centres along x and y, m, for another mass of the tool, kg.

    The observer shifts the last link together with its tool: for the same moment, by less where the tool is heavier.
    """
    last = arm.inertias()[-1].mass
    shares = np.array([1.0] * (arm.n - 1) + [(last + before) / (last + after)])
    return [_rounded(shares * np.array(shift)) for shift in (momentum.center_shift_x, momentum.center_shift_y)]


def _rounded(values: Array) -> tuple[float, ...]:
    return tuple((np.round(values, _DIGITS) + 0.0).tolist())


def _tool(found: Fit, arm: Arm, tool: Tool) -> tuple[Tool, Array]:
    """The tool with its mass and centre in the frame of the flange, and half of the centre's interval (3,), m."""
    (mass, *moment), half_widths, known = found.of("tool")
    if not known[0]:
        raise InputError("the mass of the tool is not identifiable from this motion: expected one of all joints")
    if mass < 0.0:
        raise InputError(
            f"a tool of {mass:.2f} ± {half_widths[0]:.2f} kg would explain the torques: the links differ from the "
            "model's. Fit them first (--links), with a motion of the arm without its tool, and then the tool"
        )
    if mass <= half_widths[0]:
        return dataclasses.replace(tool, mass=0.0, center=(0.0,) * 3, inertia=(0.0,) * 6), np.full(3, np.nan)
    covariance = found.covariance[found.parameters.slots["tool"], found.parameters.slots["tool"]]
    center = np.array(moment) / mass
    slopes = np.column_stack([-center / mass, np.eye(3) / mass])
    factor = half_widths[0] / np.sqrt(covariance[0, 0])
    widths = factor * np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    position = np.where(known[1:], center - arm.tip_offset, tool.center)
    found_tool = dataclasses.replace(
        tool, mass=round(float(mass), _DIGITS), center=tuple(np.round(position, _DIGITS).tolist())
    )
    return found_tool, np.where(known[1:], widths, np.nan)


def watch(arm: Arm, settings: ObserverSettings, budget: ContactBudget, recording: Recording) -> Watched:
    """Let an observer see a recording.

    Raises `InputError` if the acting torque is never known for as long as a hand-over takes.
    """
    period = recording.period
    observer = Observer(arm, settings, budget, period, locates=False)
    residuals, sudden, speeds = [], [], []
    for state in map(JointState, recording.stamps_ns.tolist(), recording.q, recording.v, recording.torque):
        observer.update(state)
        if observer.momentum.known_for >= HANDOVER_TIME:
            residuals.append(observer.momentum.residual)
            sudden.append(observer.monitor.sudden)
            speeds.append(np.abs(state.v))
    states = states_in(settings.safety.contact_debounce, period)
    if len(residuals) < states:
        raise InputError(f"the torques are never known for {HANDOVER_TIME:g} s: expected a longer recording")
    limits = np.array(budget.contact_thresholds) + np.array(budget.contact_per_speed) * np.array(speeds)
    shares = np.lib.stride_tricks.sliding_window_view(np.abs(sudden) / limits, states, axis=0).min(axis=-1)
    torques = np.array(residuals)
    return Watched(
        np.sqrt((torques**2).mean(axis=0)), shares.max(axis=0), np.abs(torques - np.array(sudden)).max(axis=0)
    )


def propose(arm: Arm, budget: ContactBudget, seen: Watched, dry_friction: Sequence[float]) -> ContactBudget:
    """The budget with thresholds as low as the free motion permits; none is raised.

    Those that report a contact, and the part of those at hand-over that is an error of the model, keep a `MARGIN` over
    it. Those that stop the arm are lowered by as much: what they permit beyond that is the permitted force. At rest
    `dry_friction` (n,), N m, may carry any part of a weight: so much always counts as an error of the model.
    """
    share = np.minimum(MARGIN * seen.used, 1.0)
    contact = _lowered(budget.contact_thresholds, share * budget.contact_thresholds, _LEAST_CONTACT)
    handed_over = _lowered(budget.handover_thresholds, np.maximum(MARGIN * seen.mean, dry_friction) + contact)
    less, less_error = np.array(budget.contact_thresholds) - contact, budget.handover_thresholds - handed_over
    values = {
        "contact_thresholds": contact,
        "contact_per_speed": share * budget.contact_per_speed,
        "sudden_thresholds": _lowered(budget.sudden_thresholds, budget.sudden_thresholds - less),
        "torque_thresholds": _lowered(budget.torque_thresholds, budget.torque_thresholds - less_error),
        "handover_thresholds": handed_over,
    }
    rounded: dict[str, Any] = {name: tuple(np.round(value, 2).tolist()) for name, value in values.items()}
    return dataclasses.replace(budget, **rounded)


def _lowered(present: Sequence[float], values: Array, least: float = _LEAST) -> Array:
    """`values` (n,) of a threshold, N m: at most its `present` ones, and at least `least` where those are not less."""
    return np.clip(values, np.minimum(least, present), present)
