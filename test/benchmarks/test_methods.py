"""The registry of methods."""

import dataclasses

import numpy as np
import pytest

from benchmarks.baselines.methods import METHODS, make_method
from benchmarks.baselines.reference_posture import PostureSpace
from benchmarks.baselines.solvers import CmaSolver, GradientSolver
from contact_reach_ros.arm import link_frames
from contact_reach_ros.arms import load_arm
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

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
    assert parts_of("start_posture") == parts_of("reference_posture")
    assert parts_of("cma_es") == (settings, others[0], CmaSolver, others[2])
    assert parts_of("gradient") == (settings, others[0], GradientSolver, others[2])


def test_law_6_pulls_to_one_posture_all_the_way():
    arm, home = load_arm(), np.array(load_arm().home)
    goal = Target(link_frames(arm, home)[1][-1] + np.array([0.1, 0.0, 0.0]))
    for name, posture in (("reference_posture", arm.default("reference_posture")), ("start_posture", home)):
        planner = make_method(arm, name, 0, 10.0, 3, SMALL).planner
        for step in range(3):
            now_ns = step * 40_000_000
            plan = planner.plan(Request(home + 0.01 * step, np.zeros(7), now_ns, now_ns, goal, Spheres.none()))
            np.testing.assert_allclose(plan.postures, np.tile(posture, (SMALL.horizon, 1)), atol=1e-6)
