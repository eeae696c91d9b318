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


PLANS = """
import json, sys
import numpy as np
from arm_simulation import ARM, HOME
from planning_helpers import PERMITTED_FORCE
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

settings = PlanningSettings(deadline=0.0, population=40, elite=10, line_search_points=40, cpus=int(sys.argv[1]))
planner = RecedingHorizonPlanner(ARM, settings, ImpedanceSettings(), PERMITTED_FORCE, capacity=1)
center, one = np.array([[0.5, 0.1, 0.5]]), np.ones(1)
spheres = Spheres(center, center, 0.1 * one, 100.0 * one, 30.0 * one)
numbers = []
for time in (0, 100_000_000, 200_000_000):
    goal = Target(np.array([0.5, 0.2, 0.4]))
    plan = planner.plan(Request(HOME, np.zeros(ARM.n), time, time + 10_000_000, goal, spheres))
    state = planner.memory.state
    numbers.append([plan.cost, plan.steps, *(part.tolist() for part in (plan.postures, plan.predicted_q, *state))])
print(json.dumps(numbers))
"""


def run(cpus: int, script: str = SCRIPT) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    # The programs of a planner, not those of the tests, which are compiled in less time.
    del environment["XLA_FLAGS"]
    arguments = [sys.executable, "-c", script, str(cpus)]
    return subprocess.run(arguments, capture_output=True, text=True, timeout=300, env=environment)


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core")
def test_two_cores_share_the_candidates_and_find_the_same():
    outcomes = [run(cpus) for cpus in (1, 2)]
    assert [outcome.returncode for outcome in outcomes] == [0, 0], outcomes[-1].stderr
    (one, alone, *found), (two, shared, *found_together) = (json.loads(each.stdout) for each in outcomes)
    assert (one, two) == (1, 2)
    # The gradient's eight lanes are not worth it.
    assert (alone, shared) == ([8, 40], [8, 24])
    assert found_together == found


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core")
def test_plans_in_contact_are_the_same_bit_for_bit_on_two_cores():
    outcomes = [run(cpus, PLANS) for cpus in (1, 2)]
    assert [outcome.returncode for outcome in outcomes] == [0, 0], outcomes[-1].stderr
    alone, shared = (json.loads(each.stdout) for each in outcomes)
    assert min(plan[1] for plan in alone) > 1
    assert shared == alone


def test_more_cores_than_there_are_are_refused():
    refused = run(65)
    assert refused.returncode == 1
    assert "cpus = 65: expected at most" in refused.stderr
