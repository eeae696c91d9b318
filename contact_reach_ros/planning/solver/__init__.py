"""Solvers, by their names in the setting `planning.solver`."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from contact_reach_ros.planning.settings import PlanningSettings
    from contact_reach_ros.planning.solver.solver import CostFunction, Solver

SOLVERS = {
    "hybrid": "hybrid:HybridSolver",
    "cma": "hybrid:plain_cma",
    "gradient": "hybrid:many_gradient_steps",
}
"""By name: a module of this folder, and its function that makes the solver from cost, number of variables and settings.

The entries are names only, so that the settings can be declared without JAX.
"""


def make_solver(cost: CostFunction[Any], n: int, settings: PlanningSettings) -> Solver[Any]:
    """The solver that the settings name, for a cost of `n` variables."""
    module, _, maker = SOLVERS[settings.solver].partition(":")
    solver: Solver[Any] = getattr(importlib.import_module(f"{__name__}.{module}"), maker)(cost, n, settings)
    return solver
