"""Memory that runs out while a plan is made: XLA's own error, in processes whose address space is bounded."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.exhaustion import with_fewer_candidates
from contact_reach_ros.planning.settings import PlanningSettings

SCRIPT = """
import json, resource, sys
import jax.numpy as jnp
import numpy as np
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.exhaustion import EXHAUSTION
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

settings = PlanningSettings(
    deadline=0.0, solver="cma", horizon=1, substeps=1, population=20000, elite=5000, max_steps=2, clearance_weight=0.0,
    least_population=int(sys.argv[1]),
)
arm = load_arm()
planner = RecedingHorizonPlanner(arm, settings, ImpedanceSettings(), 10.0, 0)
lines = []
planner.warm_up(lines.append)
said = []

def plan(at_ms):
    goal = Target(np.array([0.5, 0.2, 0.4]))
    at_ns = at_ms * 1_000_000
    try:
        rest = np.zeros(arm.n)
        plan = planner.plan(Request(np.array(arm.home), rest, at_ns, at_ns + 40_000_000, goal, Spheres.none()))
        said.append(plan.steps)
    except PlanningError as error:
        said.append(str(error))

def fill():
    # All memory but the last pieces, which Python and XLA themselves need.
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), resource.RLIM_INFINITY))
    arrays = []
    for size in (1 << 22, 1 << 20, 1 << 18, 1 << 16, 1 << 14):
        try:
            while True:
                arrays.append(jnp.zeros(size).block_until_ready())
        except EXHAUSTION as error:
            assert "RESOURCE_EXHAUSTED" in str(error)
    return arrays

for size in (1 << 22, 1 << 20, 1 << 18, 1 << 16, 1 << 14):
    jnp.zeros(size)  # compiled while there is room
plan(0)
arrays = fill()
plan(40)
arrays.clear()
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
plan(80)
print(json.dumps(said))
"""


def plans(least_population: int) -> list[int | str]:
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(least_population)],
        # XLA's threads take their memory from where this script takes it.
        env=os.environ | {"JAX_PLATFORMS": "cpu", "MALLOC_ARENA_MAX": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])


def test_plans_go_on_with_half_as_many_candidates_where_that_is_permitted():
    before, exhausted, after = plans(1000)
    assert before == after == 2
    assert "ran out of memory with planning.population = 20000" in exhausted
    assert "Out of memory allocating" in exhausted
    assert "further plans have 10000; the plan in force runs out into a hold" in exhausted


def test_plans_keep_their_candidates_otherwise():
    before, exhausted, after = plans(0)
    assert before == after == 2
    assert "expected fewer candidates, or a planning.least_population (now 0) of at most 10000" in exhausted


def exhaustion() -> jax.errors.JaxRuntimeError:
    with pytest.raises(jax.errors.JaxRuntimeError) as caught:
        jnp.zeros(1 << 50).block_until_ready()
    return caught.value


def test_halves_end_at_the_least_population():
    settings = PlanningSettings(population=200, elite=50, line_search_points=100, least_population=100)
    fewer, _ = with_fewer_candidates(settings, exhaustion())
    assert (fewer.population, fewer.elite, fewer.line_search_points) == (100, 25, 50)
    with pytest.raises(PlanningError, match="of at most 50 to go on with fewer"):
        with_fewer_candidates(fewer, exhaustion())


def test_other_errors_stay_what_they_are():
    for error in (jax.errors.JaxRuntimeError("INTERNAL: something else"), ValueError("something else")):
        with pytest.raises(type(error), match="something else"):
            with_fewer_candidates(PlanningSettings(least_population=4), error)
