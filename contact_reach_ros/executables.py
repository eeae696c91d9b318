"""Entry points of the executables.

Each lets Ctrl-C end it before it imports its node: otherwise Python would answer with a traceback during the seconds
that the imports take. The node then installs its own signal handling.
"""

from __future__ import annotations

import ctypes
import importlib
import runpy
import signal
import sys
from functools import partial

from contact_reach_ros.settings import NODES, declared_parameters

_PR_SET_PDEATHSIG = 1


def end_at_signals() -> None:
    """Let SIGINT and SIGTERM end this process at once, until others are to handle them.

    The system does it, since imports and compilers keep Python from handling signals for seconds.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


def end_with_parent() -> None:
    """In a child: be ended by the kernel when its parent is killed, so that no orphan moves an arm."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _run(module: str) -> None:
    end_at_signals()
    node = module.rpartition(".")[2]
    if node in NODES and {"-h", "--help"} & {*sys.argv}:
        print(_help(node))
    else:
        runpy.run_module(f"contact_reach_ros.{module}", run_name="__main__")


def _help(node: str) -> str:
    """How a node is started, and its parameters with accepted values and meaning."""
    # By name, as nodes are: those that import this module load less than the settings of all.
    sections = importlib.import_module("contact_reach_ros.presets").SECTIONS[node]
    arms = importlib.import_module("contact_reach_ros.arms")
    listed = declared_parameters if node == "bringup" else arms.known_parameters
    lines = [f"usage: {node} [--ros-args [-p NAME:=VALUE ...] [--params-file FILE]], see msg_docs/{node}.md", ""]
    for name, entry in listed(sections, arms.load_arm()).items():
        lines.append(f"  {name} ({entry.accepts}): {entry.description}")
    return "\n".join(lines)


driver = partial(_run, "nodes.driver")
controller = partial(_run, "nodes.controller")
observer = partial(_run, "nodes.observer")
planner = partial(_run, "nodes.planner")
adapter = partial(_run, "nodes.adapter")
recorder = partial(_run, "nodes.recorder")
replay = partial(_run, "nodes.replay")
viewer = partial(_run, "nodes.viewer")
bringup = partial(_run, "bringup.bringup")
