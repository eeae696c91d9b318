"""Running the cases of the fault matrix."""

import dataclasses
import functools

from arm_simulation import ARM
from cases import Case, shortcomings

from benchmarks.baselines.method import Method
from benchmarks.baselines.scripted import ScriptedPlanner
from benchmarks.episode import EpisodeOptions, run_episode
from benchmarks.fault_checks import LINGER
from benchmarks.faults import SMALL_PLANNER
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.world.rigid import Block
from contact_reach_ros.world.scene_file import read_scene

CONTROLLER = ControllerSettings()
TIMEOUT = 5.0
"""To reach the goal, s, but in the scene `free`."""
TABLE = Block("table", (0.45, -0.14, -0.16), (0.4, 0.4, 0.2))
"""Added to the scene `free`, under the goal."""
PERIOD = 0.05
"""Between plans, s."""


@functools.cache
def scene(name):
    if name == "table":
        return dataclasses.replace(scene("free"), environment=(*scene("free").environment, TABLE))
    if name.startswith("stiff "):
        return dataclasses.replace(scene(name.removeprefix("stiff ")), foam_scale=5.0)
    return make_scene(read_scene(name), ARM, 0)


@functools.cache
def small_planner():
    """One for all scenes but the walls, so that it is compiled once."""
    return RecedingHorizonPlanner(ARM, SMALL_PLANNER, ControllerSettings(), ContactBudget().permitted_force, capacity=1)


def run_case(case: Case) -> list[str]:
    """What the outcome of a case lacks."""
    planner = ScriptedPlanner(scene(case.scene)) if case.planner == "scripted" else small_planner()
    options = EpisodeOptions(
        period=PERIOD,
        rate=case.rate,
        settle=0.0 if case.from_start else 0.6,
        timeout=case.timeout or (4.0 if case.scene == "free" else TIMEOUT),
        linger=LINGER,
        faults=tuple(case.faults),
        watchdog=WatchdogSettings(),
    )
    result = run_episode(scene(case.scene), Method(planner, CONTROLLER), options)
    return shortcomings(case, result, CONTROLLER.limits)
