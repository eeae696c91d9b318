"""Another tool for the running stack: one node after the other, in an order in which the arm stays safe."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.parameter_files import (
    EVERY_SECTION,
    TOOL,
    TOOL_PARAMETERS,
    full_name,
    make_settings,
    parameters_in,
)
from contact_reach_ros.ros.stopping import Outcome

CARRYING = ("planner", "driver", "controller", "observer", "adapter")
"""Nodes whose tool can be changed while they run, in the order of the change: the planner first, as it lets no goal
pass meanwhile; the observer right after the controller, which waits for rest, and stops the arm if they differ."""

_PATIENCE_S, _AGAIN_S = 30.0, 0.1
"""Time until the plans for a goal that was withdrawn have run out, and between two attempts."""


def tool_in(file: Path) -> Tool:
    """The section `tool` of a parameter file; raises `SettingsError` if there is none, or it is wrong."""
    values = parameters_in(file, "controller")
    if not any(name in values for name in TOOL_PARAMETERS):
        raise SettingsError(
            f"{file}: no section '{TOOL}' for the controller; expected '/**: ros__parameters: tool: ...'"
        )
    tool: Tool = make_settings(values, EVERY_SECTION, load_arm(), str(file))[TOOL]
    return tool


def change_tool(change: Callable[[str, Mapping[str, Any]], Outcome], nodes: Sequence[str], tool: Tool) -> Outcome:
    """Give nodes another tool; reports each, and ends at the first that refuses it.

    Parameters
    ----------
    change
        Changes parameters of a node, all or none.
    nodes
        In their order. The first answers at once; the others are asked again for some seconds, until the arm rests.
    tool
        What they are to have.
    """
    values = {full_name(TOOL, entry.name): getattr(tool, entry.name) for entry in Tool.declared()}
    done: list[str] = []
    for node in nodes:
        outcome, give_up = change(node, values), time.monotonic() + (_PATIENCE_S if done else 0.0)
        while not outcome.done and time.monotonic() < give_up:
            time.sleep(_AGAIN_S)
            outcome = change(node, values)
        print(f"{node}: {'has the tool' if outcome.done else outcome.text}", flush=True)
        if not outcome.done:
            others = f"{', '.join(done)} already have it, and no plan is followed until all do: " if done else ""
            return Outcome(
                False,
                f"the {node} refuses the tool; {others}{'run the command again' if done else 'nothing has changed'}",
            )
        done.append(node)
    return Outcome(True, "the stack has the tool; the planner takes goals once it has compiled its solver for it")
