"""Entry points of the executables.

They import their node only after Ctrl-C has got its plain meaning: Python would answer it with a traceback during the
seconds that the imports take. Each node then installs its own handling of signals.
"""

from __future__ import annotations

import importlib
import signal


def _run(node: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    importlib.import_module(f"contact_reach_ros.nodes.{node}").main()


def driver() -> None:
    """Run the driver of the simulated arm."""
    _run("driver")


def controller() -> None:
    """Run the controller."""
    _run("controller")


def observer() -> None:
    """Run the observer."""
    _run("observer")


def planner() -> None:
    """Run the planner."""
    _run("planner")


def recorder() -> None:
    """Run the recorder."""
    _run("recorder")


def replay() -> None:
    """Publish a bag again."""
    _run("replay")


def bringup() -> None:
    """Run the whole stack."""
    _run("bringup")


def faults() -> None:
    """Make things go wrong."""
    _run("faults")


def viewer() -> None:
    """Serve the page for browsers."""
    _run("viewer")
