"""What the package claims, in simulated time: contact makes a goal reachable, and its planner presses less for it."""

import dataclasses

import pytest
from arm_simulation import ARM

import contact_reach_ros as cr
from benchmarks.baselines.methods import make_method
from benchmarks.baselines.rrt_star import PathSettings, find_path
from benchmarks.clutter_scenes import clutter_scene
from benchmarks.grid import DEADLINE_STEPS
from benchmarks.oracle import Kind, classify
from contact_reach_ros.arm import link_frames
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.presets import preset
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions, sphere_capacity

SEED, CLUTTER = 0, 489
"""Of the random scenes that only contact leads through, one with a single ball, whose programs other tests have."""


def run(name, scene, goal, timeout, until_settled):
    """How a method ends with what the nodes run, and a number of steps in place of deadlines."""
    shipped, force = preset("shipped", scene.arm), cr.ContactBudget().permitted_force
    planning = dataclasses.replace(shipped.planning, deadline=0.0, max_steps=DEADLINE_STEPS)
    method = make_method(scene.arm, name, sphere_capacity(scene), force, SEED, planning, shipped.controller)
    stack = cr.Stack(scene, **shipped._replace(controller=method.settings)._asdict(), planner=method.planner)
    return stack.run(goal, timeout=timeout, until_settled=until_settled)


@pytest.fixture(scope="module")
def results():
    """How the method and reference posture end in the wall scene."""
    scene = cr.load_scene("wall", arm=ARM, seed=SEED)
    names, goal = ("contact_reach", "reference_posture"), cr.Goal(scene.target)
    return {name: run(name, scene, goal, 12.0, until_settled=name == "contact_reach") for name in names}


@pytest.mark.slow
def test_the_planner_settles_at_a_fruit_among_stems():
    scene = cr.load_scene("plant", seed=17)
    goal = cr.Goal(scene.target, orientation="free")
    ours = run("contact_reach", scene, goal, 8.0, until_settled=True)
    assert ours.settled and ours.max_contact_force <= cr.ContactBudget().permitted_force


@pytest.mark.slow
def test_the_planner_gets_through_the_slalom_of_the_authors_without_their_via_point():
    scene = cr.load_scene("slalom")
    ours = run("contact_reach", scene, scene.goal, 90.0, until_settled=False)
    assert ours.reached and ours.max_contact_force <= cr.ContactBudget().permitted_force


def test_the_planner_settles_in_random_clutter_that_only_contact_leads_through():
    file, permitted = clutter_scene(ARM, CLUTTER), cr.ContactBudget().permitted_force
    scene = make_scene(file, ARM, CLUTTER)
    assert classify(ARM, scene, permitted).kind is Kind.CONTACT
    ours = run("contact_reach", scene, scene.goal, 17.0, until_settled=True)
    assert ours.settled and 0.0 < ours.max_contact_force <= permitted
    assert not run("reference_posture", scene, scene.goal, ours.duration + 1.0, until_settled=True).settled


@pytest.mark.slow
def test_the_planner_settles_at_a_goal_behind_walls_and_presses_less_than_half_as_hard_as_reference_posture(results):
    ours, theirs = results["contact_reach"], results["reference_posture"]
    assert ours.reached and ours.settled
    assert 0.0 < ours.max_contact_force < 0.5 * theirs.max_contact_force


@pytest.mark.slow
def test_contact_is_what_makes_that_goal_reachable(results):
    scene = cr.load_scene("wall", arm=ARM, seed=SEED)
    spheres = obstacle_spheres(scene, rest_positions(scene))
    rotation = link_frames(ARM, scene.start)[0][-1]
    with pytest.raises(PlanningError, match="no collision-free posture at the goal"):
        find_path(ARM, scene.start, Target(scene.target, rotation), spheres, PathSettings(clearance=0.0), seed=0)
    assert results["contact_reach"].settled
