"""Candidates divided among cores; in processes of their own, because a backend starts only once."""

import json
import os
import subprocess
import sys

import pytest

SCRIPT = """
import json, sys
import numpy as np
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.runtime import configure_jax
cpus = int(sys.argv[1])
try:
    configure_jax(None, "cpu", cpus)
except SettingsError as error:
    sys.exit(str(error))
import jax, jax.numpy as jnp
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver import make_solver

def cost(scale, points):
    shares.append(points.shape[1])
    return (scale[:, None] * (points - 0.4) ** 2).sum(axis=0) + 0.1 * jnp.sin(9.0 * points[0])

shares = []
settings = PlanningSettings(deadline=0.0, population=40, elite=10, line_search_points=40, max_steps=5, cpus=cpus)
solver = make_solver(cost, 6, settings)
scale, state = np.linspace(1.0, 3.0, 6, dtype=np.float32), solver.init(np.zeros(6), np.full(6, 0.5))
first = solver.solve(scale, state, 9.0, 0)
second = solver.solve(scale, solver.shift(first.state, first.best, np.full(6, 0.5), 2, 0.5), first.cost, 1)
print(json.dumps([len(jax.devices()), sorted(set(shares)), [*first.costs, *second.costs], second.best.tolist()]))
"""


def run(cpus: int) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", SCRIPT, str(cpus)], capture_output=True, text=True, timeout=120)


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core")
def test_two_cores_share_the_candidates_and_find_the_same():
    outcomes = [run(cpus) for cpus in (1, 2)]
    assert [outcome.returncode for outcome in outcomes] == [0, 0], outcomes[-1].stderr
    (one, alone, costs, best), (two, shared, shared_costs, shared_best) = (json.loads(each.stdout) for each in outcomes)
    assert (one, two) == (1, 2)
    # The gradient's eight lanes are not worth it.
    assert (alone, shared) == ([8, 40], [8, 24])
    assert shared_costs == pytest.approx(costs, rel=1e-6)
    assert shared_best == pytest.approx(best, rel=1e-5)


def test_more_cores_than_there_are_are_refused():
    refused = run(65)
    assert refused.returncode == 1
    assert "cpus = 65: expected at most" in refused.stderr
