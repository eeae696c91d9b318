"""What the package claims, in simulated time: contact makes a goal reachable, and its planner presses less for it."""

import dataclasses

import pytest
from arm_simulation import ARM

import contact_reach_ros as cr
from benchmarks.baselines.rrt_star import PathSettings, find_path
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.presets import Preset, preset
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

SEED = 0


def shipped() -> Preset:
    """What the nodes run; in simulated time plans have no deadline."""
    return preset("shipped", ARM)


def with_a_small_budget() -> Preset:
    """The same with a sixth of the candidates and at most four solver steps a plan: a few times as fast."""
    found = shipped()
    planning = dataclasses.replace(found.planning, population=32, line_search_points=16, max_steps=4)
    return found._replace(planning=planning, replanning=dataclasses.replace(found.replanning, period=0.04))


@pytest.fixture(
    scope="module",
    params=[pytest.param(shipped, marks=pytest.mark.slow), with_a_small_budget],
    ids=lambda one: one.__name__,
)
def results(request):
    """How the method and reference posture end in the wall scene."""
    scene, found = cr.load_scene("wall", arm=ARM, seed=SEED), {}
    for null_space in ("planned", "reference_posture"):
        settings = request.param()
        settings = settings._replace(planning=dataclasses.replace(settings.planning, null_space=null_space))
        if null_space == "reference_posture":
            # Law (6) pulls from afar.
            supervision = dataclasses.replace(settings.controller.supervision, max_posture_error=7.0)
            controller = dataclasses.replace(settings.controller, supervision=supervision)
            settings = settings._replace(controller=controller)
        stack = cr.Stack(scene, **settings._asdict())
        found[null_space] = stack.run(cr.Goal(scene.target), timeout=12.0, until_settled=null_space == "planned")
    return found


def test_the_planner_settles_at_a_goal_behind_walls_and_presses_less_than_half_as_hard_as_reference_posture(results):
    ours, theirs = results["planned"], results["reference_posture"]
    assert ours.reached
    assert ours.settled
    assert 0.0 < ours.max_contact_force < 0.5 * theirs.max_contact_force


def test_contact_is_what_makes_that_goal_reachable(results):
    scene = cr.load_scene("wall", arm=ARM, seed=SEED)
    spheres = obstacle_spheres(scene, rest_positions(scene))
    rotation = link_frames(ARM, scene.start)[0][-1]
    with pytest.raises(PlanningError, match="no collision-free posture at the goal"):
        find_path(ARM, scene.start, Target(scene.target, rotation), spheres, PathSettings(clearance=0.0), seed=0)
    assert results["planned"].settled
