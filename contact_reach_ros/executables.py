"""Entry points of the executables.

Each lets Ctrl-C end it before it imports its node: otherwise Python would answer with a traceback during the seconds
that the imports take. The node then installs its own signal handling.
"""

from __future__ import annotations

import importlib
import sys

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


def driver() -> None:
    """Run the driver of the simulated arm."""
    _run("nodes.driver")


def controller() -> None:
    """Run the controller."""
    _run("nodes.controller")


def observer() -> None:
    """Run the observer."""
    _run("nodes.observer")


def planner() -> None:
    """Run the planner."""
    _run("nodes.planner")


def adapter() -> None:
    """Run the adapter between controller and drive."""
    _run("nodes.adapter")


def recorder() -> None:
    """Run the recorder."""
    _run("nodes.recorder")


def replay() -> None:
    """Publish a bag again."""
    _run("nodes.replay")


def bringup() -> None:
    """Run the whole stack."""
    _run("bringup.bringup")


def faults() -> None:
    """Run the fault tool."""
    _run("doctor.fault_tool")


def viewer() -> None:
    """Serve the browser page."""
    _run("nodes.viewer")
