"""Identification of an arm from recordings of its free motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.fit import Fit, Motion, fit
from contact_reach_ros.identification.parameters import Parameters
from contact_reach_ros.identification.recording import Recording, make_samples
from contact_reach_ros.identification.thresholds import Watched, propose, watch
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.settings import MEASURED, MomentumSettings, ObserverSettings

TOOL, LINKS, BOTH = FITS = ("tool", "links", "both")
"""What else than friction and offsets differs from the model: a tool, the weights of the links, or both."""


_DIGITS = 5
"""Decimals of what is written."""


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
    recordings: Sequence[Recording],
    what: str = TOOL,
    without: Sequence[Recording] = (),
) -> Identification:
    """Fit the model to free motions, and see what the observer makes of them with it.

    Raises `InputError` if the recordings do not permit it.

    Parameters
    ----------
    arm
        Without a tool.
    tool
        That the nodes had.
    settings, budget
        Of the observer, as they were.
    recordings
        With the tool.
    what
        One of `FITS`. With 'links' the tool is the one that the nodes had.
    without
        Of the same arm without the tool, which tell tool and links apart: needed for 'both'.
    """
    if settings.torque_source != MEASURED:
        raise InputError("the observer takes commands for torques: identification needs torque_source: measured")
    if (what == BOTH) != bool(without):
        raise InputError("tool and links are told apart by a motion with the tool and one without it: expected both")
    momentum = settings.momentum.resolve(arm)
    motions = [Motion(make_samples(each, momentum)) for each in recordings]
    motions += [Motion(make_samples(each, momentum), has_tool=False) for each in without]
    had = arm.with_tool(tool)
    parameters = Parameters(
        had if what == LINKS else arm,
        None if what == LINKS else tool,
        what != TOOL,
        momentum.gravity_in_torque,
        momentum.rotors_in_torque,
    )
    found = fit(parameters, motions)
    new_tool, half_widths = (None, np.full(3, np.nan)) if what == LINKS else _tool(found, arm, tool)
    new = dataclasses.replace(momentum, **_values(found, arm, new_tool))
    has = had if new_tool is None else arm.with_tool(new_tool)
    before = watch(had, settings, budget, recordings[0])
    after = watch(has, dataclasses.replace(settings, momentum=new), budget, recordings[0])
    permitted = propose(arm, budget, after, new.coulomb_friction)
    return Identification(found, new_tool, half_widths, new, permitted, before, after)


def _values(found: Fit, arm: Arm, tool: Tool | None) -> dict[str, Any]:
    """The observer's settings that were fitted; friction that came out negative is none."""

    def fitted(kind: str) -> Array:
        return found.of(kind)[0] if kind in found.parameters.slots else np.zeros(arm.n)

    last = arm.inertias()[-1].mass
    # The observer shifts the last link together with its tool: by less, for the same moment.
    shares = np.array([1.0] * (arm.n - 1) + [last / (last + (0.0 if tool is None else tool.mass))])
    values = {
        "coulomb_friction": np.maximum(fitted("coulomb"), 0.0),
        "viscous_friction": np.maximum(fitted("viscous"), 0.0),
        "torque_offset": fitted("offset"),
        "center_shift_x": shares * fitted("shift_x"),
        "center_shift_y": shares * fitted("shift_y"),
    }
    return {name: tuple((np.round(value, _DIGITS) + 0.0).tolist()) for name, value in values.items()}


def _tool(found: Fit, arm: Arm, tool: Tool) -> tuple[Tool, Array]:
    """The tool with its mass and centre in the frame of the flange, and half of the centre's interval (3,), m."""
    (mass, *moment), half_widths, known = found.of("tool")
    if not known[0]:
        raise InputError("the mass of the tool is not identifiable from this motion: expected one of all joints")
    if mass < 0.0:
        raise InputError(
            f"a tool of {mass:.2f} ± {half_widths[0]:.2f} kg would explain the torques: the links differ from the "
            "model's. Fit them instead (--fit links), or both, with a recording of the arm without its tool (--without)"
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
