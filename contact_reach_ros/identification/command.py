"""`contact-reach identify`: from a motion of the running stack, or from bags, to a parameter file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import TOOL as TOOL_SECTION
from contact_reach_ros.arms import TOOL_PARAMETERS, arm_in
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.recorded_arm import arm_of_bag
from contact_reach_ros.bags.signals import read_signals
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.identify import LINKS, TOOL, identify
from contact_reach_ros.identification.output import describe, write
from contact_reach_ros.identification.recording import Recording, make_recording
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.reexecution.settings import BUDGET, recorded_sections
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import DEFAULT_PARAMETERS, full_name
from contact_reach_ros.timing import NANOSECONDS

OUTPUT = Path("identified.yaml")
_OBSERVER = "observer"


RecordedMotion = tuple[Recording, Mapping[str, Mapping[str, Any]]]
"""Joint states of free motion, and the settings of the nodes by node and full name."""


def run_identification(
    excite: Callable[[], RecordedMotion],
    bags: Sequence[Path] = (),
    links: bool = False,
    output: Path = OUTPUT,
    parameters: Path | None = None,
) -> int:
    """Identify the arm, print what was found, and write the parameter file; returns the exit code.

    Raises `ContactReachError` if there is nothing to identify from, or the motion does not identify the arm.

    Parameters
    ----------
    excite
        Moves the arm of the running stack; called if there are no bags.
    bags
        Recordings of free motion with the tool.
    links
        Fit the weights of the links, with the tool as the nodes have it; without this the tool, with the links as they
        have them.
    output
        The parameter file; the contact budget is written beside it.
    parameters
        Parameter file whose other values the new one keeps; the package's own when None.
    """
    if bags:
        read = [_read(bag) for bag in bags]
        recordings, settings, source = [each for each, _ in read], read[0][1], ", ".join(map(str, bags))
    else:
        recording, settings = excite()
        recordings, source = [recording], "a motion of the running stack"
    own = settings.get(_OBSERVER)
    if own is None:
        raise InputError(f"{source}: has no settings of the observer: record topic 'settings', too")
    sections = recorded_sections(_OBSERVER, own, source)
    arm = arm_in({name: value for name, value in own.items() if name not in TOOL_PARAMETERS}, source)
    names = {entry.name: full_name(TOOL_SECTION, entry.name) for entry in Tool.declared()}
    tool = Tool.from_mapping({name: own[full] for name, full in names.items() if full in own}, source)
    budget = sections[BUDGET].resolve(arm)
    print(f"fitting {', '.join(f'{len(each.stamps_ns) * each.period:.0f} s' for each in recordings)}", flush=True)
    found = identify(arm, tool, ObserverSettings.from_sections(sections), budget, recordings, LINKS if links else TOOL)
    print(describe(found, arm, budget))
    base = parameters or config_file(DEFAULT_PARAMETERS)
    file, budget_file = write(found, base, output, source)
    print(f"written: {file} and {budget_file}; use them with: contact-reach up --parameters {file}")
    return 0


def _read(bag: Path) -> RecordedMotion:
    """The joint states of a bag, and the settings of its nodes."""
    reader = BagReader(bag, of_stack=True)
    signals = read_signals(reader, arm_of_bag(reader).joint_names)
    contacts = sum(event.name == _OBSERVER and event.level > 0 for event in signals.safety)
    if contacts:
        print(f"{bag}: the observer reported contact {contacts} times; what touched the arm spoils the fit", flush=True)
    stamps = signals.origin_ns + np.rint(signals.position.time * NANOSECONDS).astype(np.int64)
    values = (signals.position.values, signals.velocity.values, signals.effort.values)
    return make_recording(stamps, *values, name=f"bag '{bag}'"), signals.settings
