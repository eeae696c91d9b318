"""`contact-reach identify`: from a motion of the running stack, or from a bag, to a parameter file."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import EVERY_SECTION, TOOL, TOOL_PARAMETERS, arm_in, make_settings
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import read_signals, recorded_arm, settings_of_bag
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.fit import CONFIDENCE
from contact_reach_ros.identification.identify import Identification, identify
from contact_reach_ros.identification.recording import Recording, make_recording
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.reexecution.inputs import BUDGET, recorded_sections
from contact_reach_ros.resources import config_file, write_text
from contact_reach_ros.settings import DEFAULT_PARAMETERS, parameters_in, read_yaml
from contact_reach_ros.timing import NANOSECONDS

OUTPUT = Path("identified.yaml")
_OBSERVER = "observer"

ROWS = {
    "coulomb": ("dry friction", "Nm", 1.0),
    "viscous": ("viscous friction", "Nm s/rad", 1.0),
    "offset": ("torque offset", "Nm", 1.0),
    "shift_x": ("centre of the link, x", "mm", 1000.0),
    "shift_y": ("centre of the link, y", "mm", 1000.0),
}
"""Name, unit and scale of each kind of parameters that joints or links have."""

_FOUND = ("coulomb_friction", "viscous_friction", "torque_offset", "center_shift_x", "center_shift_y")
_BUDGET_SUFFIX = "_budget"

RecordedMotion = tuple[Recording, Mapping[str, Mapping[str, Any]]]
"""Joint states of free motion, and the settings of the nodes by node and full name."""


def run_identification(
    excite: Callable[[], RecordedMotion],
    bag: Path | None = None,
    links: bool = False,
    output: Path = OUTPUT,
    parameters: Path | None = None,
) -> int:
    """Identify the arm, print what was found, and write the parameter file; returns the exit code.

    Raises `ContactReachError` if there is nothing to identify from, or the motion does not identify the arm.

    Parameters
    ----------
    excite
        Moves the arm of the running stack; called if there is no bag.
    bag
        Recording of free motion with the tool.
    links
        Fit the weights of the links, with the tool as the nodes have it; without this the tool, with the links as they
        have them.
    output
        The parameter file; the contact budget is written beside it.
    parameters
        Parameter file whose other values the new one keeps; the package's own when None.
    """
    recording, settings = _read(bag) if bag else excite()
    source = str(bag) if bag else "a motion of the running stack"
    own = settings.get(_OBSERVER)
    if own is None:
        raise InputError(f"{source}: has no settings of the observer: record topic 'settings', too")
    arm = arm_in({name: value for name, value in own.items() if name not in TOOL_PARAMETERS}, source)
    sections = recorded_sections(_OBSERVER, own, arm, source)
    of_tool = {name: value for name, value in own.items() if name in TOOL_PARAMETERS}
    tool = make_settings(of_tool, EVERY_SECTION, arm, source)[TOOL]
    budget = sections[BUDGET].resolve(arm)
    print(f"fitting {len(recording.stamps_ns) * recording.period:.0f} s", flush=True)
    found = identify(arm, tool, ObserverSettings.from_sections(sections), budget, recording, links)
    print(describe(found, arm, budget))
    base = parameters or config_file(DEFAULT_PARAMETERS)
    file, budget_file = write(found, base, output, source)
    print(f"written: {file} and {budget_file}; use them with: contact-reach up --parameters {file}")
    return 0


def _read(bag: Path) -> RecordedMotion:
    """The joint states of a bag, and the settings of its nodes."""
    reader = BagReader(bag, of_stack=True)
    settings = settings_of_bag(reader)
    signals = read_signals(reader, recorded_arm(settings))
    contacts = sum(event.name == _OBSERVER and event.level > 0 for event in signals.safety)
    if contacts:
        print(f"{bag}: the observer reported contact {contacts} times; what touched the arm spoils the fit", flush=True)
    stamps = signals.clock.origin_ns + np.rint(signals.position.time * NANOSECONDS).astype(np.int64)
    values = (signals.position.values, signals.velocity.values, signals.effort.values)
    return make_recording(stamps, *values, name=f"bag '{bag}'"), settings


def describe(found: Identification, arm: Arm, budget: ContactBudget) -> str:
    """Values with their intervals, what the residual falls to, and the proposed thresholds beside those of `budget`."""
    lines = [f"values with {100 * CONFIDENCE:.0f} % confidence intervals; ? where the motion does not tell"]
    if found.tool is not None:
        values, widths, _ = found.fit.of("tool")
        center = ", ".join(
            _with_width(1000.0 * value, 1000.0 * width, 1)
            for value, width in zip(found.tool.center, found.center_half_widths, strict=True)
        )
        lines.append(f"tool: {_with_width(values[0], widths[0], 3)} kg, centre {center} mm from the flange")
    lines.append(f"{'':29s}" + "".join(f"{name.rpartition('_')[2]:>16s}" for name in arm.joint_names))
    for kind, (name, unit, scale) in ROWS.items():
        if kind in found.fit.parameters.slots:
            values, widths, _ = found.fit.of(kind)
            digits = 2 if scale == 1.0 else 1
            pairs = zip((scale * values).tolist(), (scale * widths).tolist(), strict=True)
            texts = [_with_width(value, width, digits) for value, width in pairs]
            lines.append(f"{f'{name}, {unit}':29s}" + "".join(f"{text:>16s}" for text in texts))
    for name, before, after in (
        ("external torque rms, Nm", found.before.rms, found.after.rms),
        ("contact_thresholds, Nm", budget.contact_thresholds, found.budget.contact_thresholds),
        ("sudden_thresholds, Nm", budget.sudden_thresholds, found.budget.sudden_thresholds),
        ("torque_thresholds, Nm", budget.torque_thresholds, found.budget.torque_thresholds),
        ("handover_thresholds, Nm", budget.handover_thresholds, found.budget.handover_thresholds),
    ):
        texts = [f"{old:.2f} > {new:.2f}" for old, new in zip(before, after, strict=True)]
        lines.append(f"{name:29s}" + "".join(f"{text:>16s}" for text in texts))
    lines.append(f"external torque of free motion falls to {found.rms_ratio:.2f} of before")
    lines += [f"not identifiable from this motion: {words}" for words in found.fit.unknown]
    return "\n".join(lines)


def _with_width(value: float, width: float, digits: int) -> str:
    return "?" if np.isnan(width) else f"{value:.{digits}f} ± {width:.{digits}f}"


def write(found: Identification, base: Path, file: Path, source: str) -> tuple[Path, Path]:
    """Write a parameter file for all nodes, and the contact budget that it names beside it; returns both paths.

    Parameters
    ----------
    found
        What to write.
    base
        Parameter file whose other values it keeps.
    file
        The new one.
    source
        What the values come from, for a comment.

    Raises
    ------
    SettingsError
        If the base is no parameter file.
    InputError
        If a file cannot be written.
    """
    file = file.resolve()
    budget_file = file.with_name(f"{file.stem}{_BUDGET_SUFFIX}{file.suffix or '.yaml'}")
    parameters_in(base, _OBSERVER)
    content = read_yaml(base)
    momentum = {name: getattr(found.momentum, name) for name in _FOUND}
    values: dict[str, dict[str, Any]] = {
        "observer": {"momentum": momentum, "contact_budget": str(budget_file)},
    }
    if found.tool is not None:
        values["/**"] = {TOOL: dataclasses.asdict(found.tool)}
    _update(content, {node: {"ros__parameters": own} for node, own in values.items()})
    for path, tree in ((file, content), (budget_file, dataclasses.asdict(found.budget))):
        text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=120)
        write_text(path, f"# Written by contact-reach identify, from {source}.\n{text}")
    return file, budget_file


def _update(tree: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Put values into a tree, deep into the branches that it has."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            tree[key] = tree.get(key) or {}
            _update(tree[key], value)
        else:
            tree[key] = value
