"""The episodes of Table I: each a pure function of its cell and the settings, in any process and any order."""

from __future__ import annotations

import dataclasses
import functools
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.baselines.method import Method
from benchmarks.baselines.methods import PATH_METHODS, PLANLESS, make_method
from benchmarks.episode import EpisodeOptions, run_episode
from benchmarks.identified import identified, of_arm
from benchmarks.metrics import EpisodeMetrics, measure
from benchmarks.paper import JOINT_TORQUE
from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import DEFAULT_ARM, load_arm
from contact_reach_ros.control.settings import AUTO, ControllerSettings
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.planning.planner import ReplanningSettings
from contact_reach_ros.planning.settings import PlanningSettings, UnexpectedContactSettings
from contact_reach_ros.presets import preset
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import SceneFile
from contact_reach_ros.world.spheres import sphere_capacity

GOALS = ("hold", "free")
"""Goals with the orientation of the start held, or with a position only."""

Record = dict[str, Any]
"""Cell, figures and timing of one episode, as JSON has them."""

PATH_PATIENCE = 4
"""Factor on the time limit of methods that follow a path: it may be long, but it ends at the goal."""

PATIENCE = 10.0
"""s: an arm whose joints have stayed where they are for so long, longer than before any detour, is lost."""

METRICS = tuple(field.name for field in dataclasses.fields(EpisodeMetrics))

DEADLINE_STEPS = 5
"""Solver steps that the node's deadline of 30 ms holds in the wall scene beside other work, where a step takes 5.3 to
5.5 ms; a quiet core takes 3.4 (docs/planning.md), and with fewer obstacles it holds more."""

_SOLVER_SEEDS = 2**24
"""Few enough that a search of several runs can derive seeds of 32 bits from each."""


@dataclass(frozen=True)
class Cell:
    """One episode.

    Attributes
    ----------
    scene
        Name of the scene file.
    goal
        One of `GOALS`.
    method
        One of `METHODS`.
    target
        Seed of the scene: its target and where its obstacles are.
    repeat
        Seeds solver and sensor noise together with the target; the scene does not depend on it.
    variant
        Name of its setup, in runs that compare several.
    """

    scene: str
    goal: str
    method: str
    target: int
    repeat: int = 0
    variant: str = ""


@dataclass(frozen=True)
class Setup:
    """What all episodes have in common; by default exact: without a deadline, results depend on no machine."""

    arm: str = DEFAULT_ARM
    """Name of the arm; each process loads it."""
    preset: str = ""
    """Name of the preset that the settings come from, if they do."""
    planning: PlanningSettings = field(default_factory=lambda: PlanningSettings(deadline=0.0))
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    unexpected_contact: UnexpectedContactSettings = field(default_factory=UnexpectedContactSettings)
    budget: ContactBudget = field(default_factory=ContactBudget)
    replanning: ReplanningSettings | None = None
    """Of methods whose plans take time; None to begin each plan when the last one takes effect."""
    capacity: int | None = None
    """Number of spheres that planners take, so that scenes with different numbers share a program; by default the
    scene's."""
    timeout: float = 20.0
    """Time to reach the goal, s, for methods that follow no path."""

    @classmethod
    def of(cls, name: str, budget: ContactBudget, arm: str = DEFAULT_ARM, task: str = AUTO, **changes: Any) -> Setup:
        """The setup of a preset for an arm and a task.

        Raises `SettingsError` if there is no preset of this name, or the arm cannot hold the task.

        A deadline on the wall clock, which would make results depend on the machine, is `DEADLINE_STEPS`.
        """
        found = preset(name, load_arm(arm))
        impedance = dataclasses.replace(found.controller.impedance, task=task).resolve(load_arm(arm))
        found = found._replace(controller=dataclasses.replace(found.controller, impedance=impedance))
        if found.planning.deadline:
            planning = dataclasses.replace(found.planning, deadline=0.0, max_steps=DEADLINE_STEPS)
            found = found._replace(planning=planning)
        return cls(arm=arm, preset=name, budget=budget, **{**found._asdict(), **changes})

    def latency(self, method: str) -> float:
        """Time from a state to the effect of its plan, s; one that plans nothing in between answers at once."""
        replanning = None if method in PLANLESS else self.replanning
        return (replanning or ReplanningSettings()).latency

    def options(self, method: str, goal: str, latency: float, noise_seed: int | None = None) -> EpisodeOptions:
        """Options of an episode in which each plan takes `latency`, s."""
        period = latency
        if self.replanning is not None:
            period = (ReplanningSettings() if method in PLANLESS else self.replanning).period
        return EpisodeOptions(
            period=period,
            latency=latency,
            timeout=self.timeout * (PATH_PATIENCE if method in PATH_METHODS else 1),
            hold_orientation=goal == "hold",
            until_settled=True,
            patience=PATIENCE,
            budget=self.budget,
            noise_seed=noise_seed,
            # Nothing but the plan keeps torques that are applied as they are from moving the arm too fast.
            watchdog=WatchdogSettings(speed_share=0.0) if method == JOINT_TORQUE else WatchdogSettings(),
            unexpected_contact=self.unexpected_contact,
        )


@dataclass(frozen=True)
class EpisodeTask:
    """All that a worker needs to run one episode; `latency` in s."""

    cell: Cell
    scene: SceneFile
    latency: float
    setup: Setup


def episode_seeds(target: int, repeat: int) -> tuple[int, int]:
    """Seeds of solver and sensor noise, the same for every scene, goal and method."""
    solver, noise = np.random.SeedSequence((target, repeat)).generate_state(2)
    return int(solver) % _SOLVER_SEEDS, int(noise)


def run_cell(task: EpisodeTask) -> Record:
    """Run an episode; one that cannot run is recorded as failed, with the reason."""
    try:
        arm = load_arm(task.setup.arm)
        scene = concrete_scene(task.scene, arm, task.cell.target)
        method = prepared(task.cell.method, task.scene, task.setup)
        solver_seed, noise_seed = episode_seeds(task.cell.target, task.cell.repeat)
        method.reseed(solver_seed)
        options = task.setup.options(task.cell.method, task.cell.goal, task.latency, noise_seed)
        momentum = identified(scene.arm, of_arm(scene.mismatch))
        options = dataclasses.replace(options, observer=ObserverSettings(momentum=momentum))
        wall, cpu = time.perf_counter(), time.process_time()
        result = run_episode(scene, method, options)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    except ContactReachError as error:
        return failed(task.cell, f"{type(error).__name__}: {error}")
    gains, permitted_force = task.setup.controller.impedance, task.setup.budget.permitted_force
    metrics = measure(result, scene.target, task.setup.planning, gains, permitted_force)
    times = [plan.solve_s for plan in result.plans]
    timing = {
        "wall_s": wall,
        "cpu_s": cpu,
        "first_plan_s": times[0] if times else None,
        "plan_s": float(np.median(times)) if times else None,
    }
    return {**dataclasses.asdict(task.cell), **dataclasses.asdict(metrics), "timing": timing}


def failed(cell: Cell, message: str) -> Record:
    """The record of an episode that has no figures."""
    nothing: dict[str, Any] = dict.fromkeys(METRICS)
    nothing.update(reached=False, success=False, stop_reason="", failure=message, plans=0, solver_steps=0)
    return {**dataclasses.asdict(cell), **nothing, "timing": None}


def cell_of(record: Record) -> Cell:
    """The cell of a record."""
    return Cell(*(record.get(field.name, field.default) for field in dataclasses.fields(Cell)))


@functools.lru_cache(maxsize=16)
def concrete_scene(file: SceneFile, arm: Arm, target: int) -> Scene:
    """The scene of a seed, cached because placing walls takes a while."""
    return make_scene(file, arm, target)


def prepared(method: str, file: SceneFile, setup: Setup) -> Method:
    """A method that is ready to plan, cached for the next episode in this process."""
    return _prepared(
        file.equipped(load_arm(setup.arm)),
        method,
        sphere_capacity(file) if setup.capacity is None else setup.capacity,
        setup.budget.permitted_force,
        setup.planning,
        setup.controller,
    )


@functools.cache
def _prepared(
    arm: Arm,
    name: str,
    capacity: int,
    permitted_force: float,
    planning: PlanningSettings,
    controller: ControllerSettings,
) -> Method:
    method = make_method(arm, name, capacity, permitted_force, 0, planning, controller)
    method.warm_up(lambda line: None)
    return method
