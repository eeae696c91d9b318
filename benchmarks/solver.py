"""`contact-reach bench solver`: solvers at equal wall time, or after ten steps each (Section V-C)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError
from benchmarks.episode import EpisodeOptions
from benchmarks.machine import machine
from benchmarks.output import Report, say, write_report
from benchmarks.recorded_runs import RecordedPlan, RecordingPlanner, record_runs, spread_states
from benchmarks.solver_race import plot_race, race_table, run_race
from benchmarks.solver_steps import compare_steps, steps_table
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.action_space import ReferenceSpace, scaled_cost
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.spheres import sphere_capacity


def bench_solver(
    scenes: Sequence[str] = ("ball", "wall"),
    states: int = 40,
    seconds: float = 0.1,
    steps: bool = False,
    plot: Path | None = None,
    file: Path | None = None,
    settings: PlanningSettings | None = None,
) -> Report:
    """Run every solver from the same states; print a table and write JSON to `file`.

    The states are spread over real closed-loop runs, half of them with contact where there is that much.

    Parameters
    ----------
    scenes
        Names or files.
    states
        In each scene, each with random numbers of its own; at least 2.
    seconds
        For each search.
    steps
        Compare after ten steps instead, in several configurations of Algorithm 1.
    plot
        File for a picture of the costs over time.
    settings
        Of the planner; the paper's budget by default.

    Raises
    ------
    InputError
        If there are too few states for a confidence interval, or no time.
    """
    if states < 2:
        raise InputError(f"states = {states}: expected at least 2, for a confidence interval")
    if not 0.001 <= seconds <= 60.0:
        raise InputError(f"seconds = {seconds:g}: expected 0.001 to 60")
    settings = dataclasses.replace(settings or PlanningSettings(), deadline=0.0)
    report: Report = {}
    for scene in scenes:
        name, found = _states(scene, settings, states)
        say(f"{name}: {len(found)} states, {sum(state.touches for state in found)} with contact")
        if steps:
            report[name] = compare_steps(settings, found)
        else:
            space = ReferenceSpace(load_arm(), settings, ImpedanceSettings())
            report[name] = run_race(scaled_cost(space), len(space.bounds), settings, found, seconds)
        write_report(report, file)
    names = list(report)
    print(steps_table(report, names) if steps else race_table(report, names))
    if plot is not None and not steps:
        plot_race(report, names, plot)
    report["machine"] = machine()
    write_report(report, file)
    return report


def _states(scene: str, settings: PlanningSettings, count: int) -> tuple[str, list[RecordedPlan]]:
    """The scene's name, and plans that its closed-loop runs made."""
    scene_file, options = read_scene(scene), EpisodeOptions(budget=load_budget())
    permitted_force, capacity = options.budget.permitted_force, sphere_capacity(scene_file)
    planner = RecordingPlanner(load_arm(), settings, ImpedanceSettings(), permitted_force, capacity)
    planner.warm_up(say)
    runs = record_runs(planner, scene_file, 4 * count, 0, options, episodes=3)
    return scene_file.name, spread_states(runs.warm, count)
