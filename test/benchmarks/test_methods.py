"""The registry of methods."""

import dataclasses

import pytest

from benchmarks.baselines.methods import METHODS, make_method
from benchmarks.baselines.reference_posture import PostureSpace
from benchmarks.baselines.solvers import CmaSolver, GradientSolver
from contact_reach_ros.arms import load_arm
from contact_reach_ros.planning.settings import PlanningSettings

SMALL = PlanningSettings(deadline=0.0, population=16, max_steps=2)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "joint_torque")) for name in METHODS]
)
def test_every_name_makes_a_method(name):
    method = make_method(load_arm(), name, capacity=0, permitted_force=10.0, seed=1, settings=SMALL)
    assert method.controller(load_arm(), method.settings).stop_reason == ""
    assert callable(method.planner.warm_up)


def test_methods_differ_in_what_their_names_say_and_in_nothing_else():
    def parts_of(name: str) -> tuple[PlanningSettings, type, type, type]:
        planner = make_method(load_arm(), name, 0, 10.0, 3, SMALL).planner
        return planner._settings, *(type(part) for part in (planner._space, planner._solver, planner._predictor))

    settings, *others = parts_of("contact_reach")
    direct = dataclasses.replace(settings, detour_patience=0.0)
    assert settings == SMALL
    assert parts_of("no_detours") == (direct, *others)
    assert parts_of("reference_posture") == (direct, PostureSpace, *others[1:])
    assert parts_of("cma_es") == (settings, others[0], CmaSolver, others[2])
    assert parts_of("gradient") == (settings, others[0], GradientSolver, others[2])
