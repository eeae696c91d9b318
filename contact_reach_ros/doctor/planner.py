"""How long the planner takes here to be ready, and for a plan: measured in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.doctor.findings import Finding, failed, passed, warned
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.robot import iiwa14

SPHERES = 1
"""Obstacle spheres that the planner looks at unless told otherwise."""

_PLANS = 10
_TIMEOUT_S = 600.0
_LATE = 2.5


def planner_speed(parameters: Mapping[str, Any]) -> Finding:
    """Prepare the planner and plan a few times.

    Parameters
    ----------
    parameters
        Of the planner node, dotted names; those that are missing have their defaults, and without `latency` there is
        nothing to compare the time of a plan with.
    """
    name = "planner"
    command = [sys.executable, "-m", __spec__.name, json.dumps(dict(parameters))]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        fix = "look whether something else fills the machine (top), then try again"
        return failed(name, f"not ready after {_TIMEOUT_S:.0f} s", fix)
    if result.returncode:
        last = result.stderr.strip().splitlines()[-1:] or [f"exit code {result.returncode}"]
        fix = "put right what the message names in the planner's parameters; pip install -c constraints.txt brax jax"
        return failed(name, last[0], fix)
    values = json.loads(result.stdout.splitlines()[-1])
    latency = float(parameters.get("latency", np.inf))
    solve, compile_s = values["solve_ms"] / 1000, values["compile_s"]
    found = (
        f"ready after {compile_s:.1f} s, a plan takes {1000 * solve:.1f} ms with {values['spheres']} obstacle spheres "
        f"on {values['device']}"
    )
    fix = "lower planning.deadline or planning.population, raise latency and period, or use a GPU (planning.device)"
    if solve > _LATE * latency:
        return failed(name, found, fix, **values)
    if solve > latency:
        return warned(name, f"{found}, later than its effect after {1000 * latency:.0f} ms", fix, **values)
    return passed(name, found, **values)


def _measure(parameters: Mapping[str, Any]) -> dict[str, Any]:
    import time

    import jax

    from contact_reach_ros.planning.problem import Goal, Spheres
    from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner

    def section(prefix: str) -> dict[str, Any]:
        return {key.removeprefix(prefix): value for key, value in parameters.items() if key.startswith(prefix)}

    spheres = int(parameters.get("max_spheres", SPHERES))
    began = time.perf_counter()
    planner = RecedingHorizonPlanner(
        PlanningSettings.from_mapping(section("planning."), "planner"),
        ImpedanceSettings.from_mapping(section("impedance."), "planner"),
        load_budget(parameters.get("contact_budget", "")).permitted_force,
        spheres,
    )
    planner.warm_up(lambda _: None)
    compile_s = time.perf_counter() - began
    q, v = np.array(iiwa14.HOME_POSITION), np.zeros(iiwa14.N_JOINTS)
    goal, times = Goal(np.array([0.5, 0.2, 0.3])), []
    for index in range(_PLANS):
        now_ns = 1_000_000_000 + index * 50_000_000
        start = time.perf_counter()
        planner.plan(q, v, now_ns, now_ns + 40_000_000, goal, Spheres.none())
        times.append(time.perf_counter() - start)
    return {
        "compile_s": compile_s,
        "solve_ms": 1000 * float(np.median(times)),
        "spheres": spheres,
        "device": jax.default_backend(),
    }


if __name__ == "__main__":
    print(json.dumps(_measure(json.loads(sys.argv[1]))))
