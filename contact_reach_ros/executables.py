"""Entry points of the executables.

Each lets Ctrl-C end it before it imports its node: otherwise Python would answer with a traceback during the seconds
that the imports take. The node then installs its own signal handling.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import runpy
import signal
import sys
import threading
from functools import partial
from types import FrameType

from contact_reach_ros.settings import NODES, declared_parameters

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_watcher: threading.Thread | None = None
_PR_SET_PDEATHSIG = 1


def end_at_signals() -> None:
    """End this process at SIGINT or SIGTERM, with exit code 0, until others are to handle them.

    Imports and compilers keep the main thread from handling signals for seconds: another thread does it for that long.
    """
    global _watcher
    for number in _SIGNALS:
        signal.signal(number, _end)
    if _watcher is None:
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        _watcher = threading.Thread(target=_watch, args=[reader], name="starting", daemon=True)
        _watcher.start()


def end_with_parent() -> None:
    """In a child: be ended by the kernel when its parent is killed, so that no orphan moves an arm."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _end(number: int, frame: FrameType | None) -> None:
    os._exit(0)


def _watch(reader: int) -> None:
    while data := os.read(reader, 1):
        # A handler that was set meanwhile does more than end the process.
        if signal.getsignal(data[0]) is _end:
            os._exit(0)


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
