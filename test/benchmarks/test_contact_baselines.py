"""The baselines that know of contact or of no plan: forces, paths below the permitted one, straight motion."""

import numpy as np
from arm_simulation import ARM, HOME

from benchmarks.baselines.contact_rrt import find_contact_path
from benchmarks.baselines.reactive import ReactivePlanner
from contact_reach_ros.arm import link_frames
from contact_reach_ros.planning.paths import Statics
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

ELBOW = link_frames(ARM, HOME)[1][3]
FLANGE, ROTATION = link_frames(ARM, HOME)[1][-1], link_frames(ARM, HOME)[0][-1]


def ball(center, stiffness=100.0, radius=0.1):
    one = np.ones(1)
    return Spheres(np.array([center]), np.array([center]), radius * one, stiffness * one, 30.0 * one)


def test_no_path_presses_harder_than_permitted():
    goal = Target(FLANGE + np.array([0.0, 0.15, -0.1]), ROTATION)
    q = HOME.copy()
    q[0] += 0.25
    in_the_way = link_frames(ARM, q)[1][3] + np.array([0.0, 0.12, 0.0])
    spheres = ball(in_the_way, 300.0)
    path = find_contact_path(ARM, HOME, goal, spheres, 10.0, seed=1)
    np.testing.assert_array_equal(path.postures[0], HOME)
    np.testing.assert_allclose(link_frames(ARM, path.postures[-1])[1][-1], goal.position, atol=1e-3)
    force = Statics(ARM, spheres, HOME, goal).forces
    for start, end in zip(path.postures[:-1], path.postures[1:], strict=True):
        assert force(start + np.linspace(0.0, 1.0, 30)[:, None] * (end - start)).max() <= 11.0
    again = find_contact_path(ARM, HOME, goal, spheres, 10.0, seed=1)
    np.testing.assert_array_equal(path.postures, again.postures)


def test_without_a_planner_the_reference_leads_straight_to_the_goal_at_the_bounds():
    settings = PlanningSettings()
    planner = ReactivePlanner(ARM, settings)
    goal = Target(FLANGE + np.array([0.3, -0.002, 0.0]), ROTATION)
    plan = planner.plan(Request(HOME, np.zeros(7), 0, 40_000_000, goal, Spheres.none()))
    np.testing.assert_allclose(plan.positions[0] - FLANGE, [settings.translation_bound, -0.002, 0.0], atol=1e-12)
    np.testing.assert_allclose(plan.rotations[0], ROTATION, atol=1e-12)
    np.testing.assert_array_equal(plan.postures[0], HOME)
