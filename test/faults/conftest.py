"""Running the cases of the fault matrix, each once."""

import functools

import pytest
from cases import CASES, Case, shortcomings
from page import write
from scripted import ScriptedPlanner

from contact_reach_ros.baselines.method import ReferenceMethod
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings, SupervisionSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, run_episode
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.plant.drive import WatchdogSettings
from contact_reach_ros.plant.fault_schedules import parse_faults
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.spheres import sphere_capacity

CONTROLLER = ControllerSettings(supervision=SupervisionSettings(hold_limit=0.5))
SMALL = PlanningSettings(population=32, elite=8, line_search_points=16, max_steps=3, deadline=0.0)
TIMEOUTS = {"free": 4.0, "ball": 5.0, "wall": 5.0}

_outcomes: dict[str, tuple] = {}


@functools.cache
def scene(name):
    return make_scene(read_scene(name), 0)


@functools.cache
def small_planner(name):
    file = read_scene(name)
    return RecedingHorizonPlanner(SMALL, ImpedanceSettings(), ContactBudget().permitted_force, sphere_capacity(file))


def run_case(case: Case) -> tuple:
    """Outcome of a case and what it lacks."""
    if case.name not in _outcomes:
        planner = ScriptedPlanner(scene(case.scene)) if case.planner == "scripted" else small_planner(case.scene)
        options = EpisodeOptions(
            settle=0.6,
            timeout=case.timeout or TIMEOUTS[case.scene],
            linger=1.0,
            faults=parse_faults(case.fault),
            watchdog=WatchdogSettings(),
        )
        result = run_episode(scene(case.scene), ReferenceMethod(planner, CONTROLLER), options)
        _outcomes[case.name] = (result, shortcomings(case, result, CONTROLLER.limits))
    return _outcomes[case.name]


@pytest.fixture(scope="session", autouse=True)
def written_page(request):
    """With --write-faults: the page with what this run found."""
    yield
    if request.config.getoption("--write-faults"):
        write({case.name: run_case(case) for case in CASES})
