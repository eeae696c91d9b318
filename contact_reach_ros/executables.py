"""Entry points of the executables.

Each lets Ctrl-C end it before it imports its node: otherwise Python would answer with a traceback during the seconds
that the imports take. The node then installs its own signal handling.
"""

from __future__ import annotations

import importlib
import sys
from functools import partial

from contact_reach_ros.command_line import answer, asks_for_help, foreign_arguments
from contact_reach_ros.parameter_files import NODES
from contact_reach_ros.starting import end_at_signals


def _run(module: str) -> None:
    end_at_signals()
    node, arguments = module.rpartition(".")[2], sys.argv[1:]
    if node in NODES and (asks_for_help(arguments) or foreign_arguments(arguments)):
        # The node itself would answer the same after the seconds that its imports take.
        from contact_reach_ros.node_settings import ALL_SECTIONS

        sys.exit(answer(node, ALL_SECTIONS[node], arguments))
    importlib.import_module(f"contact_reach_ros.{module}").main()


driver = partial(_run, "nodes.driver")
controller = partial(_run, "nodes.controller")
observer = partial(_run, "nodes.observer")
planner = partial(_run, "nodes.planner")
adapter = partial(_run, "nodes.adapter")
recorder = partial(_run, "nodes.recorder")
replay = partial(_run, "nodes.replay")
viewer = partial(_run, "nodes.viewer")
bringup = partial(_run, "bringup.bringup")
