"""The registry of methods."""

import dataclasses

import pytest

from benchmarks.baselines.methods import METHODS, make_method
from contact_reach_ros.arms import load_arm
from contact_reach_ros.planning.settings import PlanningSettings

SMALL = PlanningSettings(deadline=0.0, population=16, line_search_points=8, max_steps=2)


@pytest.mark.parametrize("name", METHODS)
def test_every_name_makes_a_method(name):
    method = make_method(load_arm(), name, capacity=0, permitted_force=10.0, seed=1, settings=SMALL)
    assert method.controller(load_arm(), method.settings).stop_reason == ""
    assert callable(method.planner.warm_up)


def test_methods_differ_in_what_their_names_say_and_in_nothing_else():
    def settings_of(name: str) -> PlanningSettings:
        return make_method(load_arm(), name, 0, 10.0, 3, SMALL).planner._settings

    ours = settings_of("contact_reach")
    assert ours == dataclasses.replace(SMALL, seed=3)
    assert settings_of("reference_posture") == dataclasses.replace(ours, null_space="reference_posture")
    assert settings_of("cma_es") == dataclasses.replace(ours, solver="cma")
    assert settings_of("gradient") == dataclasses.replace(ours, solver="gradient")
