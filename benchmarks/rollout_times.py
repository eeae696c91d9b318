"""What a batch of rollouts costs: in the planner's transfer model, in Brax's pipeline and in plain MuJoCo."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence

import jax
import mujoco
import mujoco.rollout
import numpy as np

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.output import Report, say
from contact_reach_ros.experiments.recorded_runs import RecordedRuns, Solve
from contact_reach_ros.planning.action_space import ReferenceSpace, scaled_cost
from contact_reach_ros.planning.objectives import action_bounds
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.simulation.plant import TICK, Plant
from contact_reach_ros.simulation.settings import JointSettings, SensorSettings
from contact_reach_ros.world.scene import Scene

_MANY_SPHERES, _FEW_CANDIDATES = 4, 8
"""With more spheres than this, Brax would take minutes for a whole batch: it gets this many candidates instead."""


def measure_rollouts(
    runs: RecordedRuns, settings: PlanningSettings, gains: ImpedanceSettings, pipelines: Sequence[str], rounds: int
) -> Report:
    """Time of one batch of candidates in the planner's transfer model, in Brax's pipeline and in plain MuJoCo.

    All are measured in turns, `rounds` times, on a problem of the runs.
    """
    arm, problem = runs.scenes[0].arm, typical(runs).problem
    bounds = action_bounds(arm, settings, gains)
    obstacles = problem.obstacles
    spheres = 0 if obstacles is None else obstacles.radius.shape[0]
    shape = (len(bounds), settings.population)
    every = np.random.default_rng(settings.seed).uniform(-1.0, 1.0, shape).astype(np.float32)
    programs: dict[str, Callable[[], object]] = {}
    steps: dict[str, int] = {}
    lanes: dict[str, int] = {"mujoco": settings.population}
    for name in ("closed_loop", *pipelines):
        space = ReferenceSpace(arm, dataclasses.replace(settings, pipeline=name), gains)
        cost = jax.jit(scaled_cost(space))
        steps[name] = space.objective.integration_steps
        lanes[name] = settings.population
        if name != "closed_loop" and spheres > _MANY_SPHERES:
            lanes[name] = min(settings.population, _FEW_CANDIDATES)
        points = every[:, : lanes[name]]
        say(f"compiling a batch of {lanes[name]} candidates, {name}")
        began = time.perf_counter()
        jax.block_until_ready(cost(problem, points))
        say(f"  {time.perf_counter() - began:.1f} s")
        programs[name] = functools.partial(_run, cost, problem, points)
    duration = settings.horizon * settings.knot_duration
    programs["mujoco"] = _mujoco_batch(runs.scenes[0], settings.population, duration, threads=2)
    times, cpu_times = _alternately(programs, rounds, {"closed_loop": 20, "mujoco": 3})
    # Brax's time is in proportion to the number of candidates, whatever that is.
    times = {name: value * settings.population / lanes[name] for name, value in times.items()}
    own = times["closed_loop"]
    candidate_steps = settings.population * steps["closed_loop"]

    def compared(name: str, count: int) -> Report:
        return {
            "batch_ms": 1e3 * times[name],
            "timestep_ms": 1e3 * duration / count,
            "us_per_candidate_and_step": 1e6 * times[name] / (settings.population * count),
            "s_per_simulated_s": times[name] / (settings.population * duration),
            "ratio_to_closed_loop": times[name] / own,
            "candidates_measured": lanes[name],
        }

    report: Report = {
        "rollout_us_per_substep": 1e6 * own / candidate_steps,
        "rollout_cpu_us_per_substep": 1e6 * cpu_times["closed_loop"] / candidate_steps,
        "rollout_batch_ms": 1e3 * own,
        "rollout_s_per_simulated_s": own / (settings.population * duration),
        "brax": {name: compared(name, steps[name]) for name in pipelines},
        "mujoco_two_threads": compared("mujoco", round(duration / TICK)),
    }
    if "generalized" in pipelines:
        report["speedup_vs_generalized"] = times["generalized"] / own
    return report


def _run(program: Callable[..., jax.Array], *arguments: object) -> None:
    jax.block_until_ready(program(*arguments))


def _mujoco_batch(scene: Scene, candidates: int, duration: float, threads: int) -> Callable[[], object]:
    """A rollout of the plant's own MuJoCo model, held against gravity by constant torques, without any controller."""
    plant = Plant(scene, SensorSettings(), JointSettings())
    model, data = plant.model, plant.data
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    count = round(duration / TICK)
    control = np.tile(data.qfrc_bias[: scene.arm.n], (candidates, count, 1))
    states = np.tile(state, (candidates, 1))
    workers = [mujoco.MjData(model) for _ in range(threads)]
    return lambda: mujoco.rollout.rollout(model, workers, states, control)


def typical(runs: RecordedRuns) -> Solve:
    """A recorded solve with contact if there is one, from the middle of the runs."""
    warm = runs.warm
    touching = [recorded for recorded in warm if recorded.touches]
    chosen = touching or warm
    return chosen[len(chosen) // 2].solve


def _alternately(
    programs: dict[str, Callable[[], object]], rounds: int, repeated: dict[str, int]
) -> tuple[dict[str, float], dict[str, float]]:
    """Median wall-clock and processor time of each program in s, measured in turns.

    `repeated`: how often a program runs in each round; once if it is not listed.
    """
    wall_times: dict[str, list[float]] = {name: [] for name in programs}
    cpu_times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            for _ in range(repeated.get(name, 1)):
                cpu, wall = time.process_time(), time.perf_counter()
                program()
                wall_times[name].append(time.perf_counter() - wall)
                cpu_times[name].append(time.process_time() - cpu)
    medians = ({name: float(np.median(values)) for name, values in kind.items()} for kind in (wall_times, cpu_times))
    wall_medians, cpu_medians = medians
    return wall_medians, cpu_medians
