"""`Stack` as a user of the library meets it: wrong uses are refused in words, and stops are released."""

import numpy as np
import pytest
from plans import StayingCore

import contact_reach_ros as cr

ARM = cr.load_arm("iiwa14")
NEAR = [0.5, 0.2, 0.3]


@pytest.fixture(scope="module")
def scene() -> cr.Scene:
    return cr.load_scene("ball", arm=ARM, seed=0)


@pytest.fixture
def stack(scene) -> cr.Stack:
    return cr.Stack(scene, planner=StayingCore())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda scene: cr.load_scene("bal"), "scene 'bal' is unknown; expected one of authors_ball, "),
        (lambda scene: cr.load_scene("ball", seed=-1), "seed = -1: expected an integer from 0 on"),
        (lambda scene: cr.load_scene("ball", seed=1.5), "seed = 1.5: expected an integer from 0 on"),
        (lambda scene: cr.load_scene("ball", target=[np.nan, 0.0, 0.0]), "goal: position"),
        (lambda scene: cr.Stack(scene, seed=1.5), "seed = 1.5: expected an integer"),
        (lambda scene: cr.Stack(scene, period=0.0015), "period = 1.5 ms"),
    ],
)
def test_scenes_and_stacks_that_cannot_be_made_are_refused(scene, make, message):
    with pytest.raises(cr.ContactReachError, match=message):
        make(scene)


def test_settings_take_numbers_and_arrays_of_numpy():
    settings = cr.PlanningSettings(goal_weight=np.float32(2.0), horizon=np.int64(4))
    assert settings == cr.PlanningSettings(goal_weight=2.0, horizon=4)
    assert type(settings.horizon) is int and type(settings.goal_weight) is float
    for wrong in ({"horizon": np.float64(3.5)}, {"goal_weight": np.zeros(2)}, {"horizon": np.bool_(True)}):
        with pytest.raises(cr.ContactReachError, match="expected a"):
            cr.PlanningSettings(**wrong)


def test_planner_controller_and_observer_of_the_user_are_used(scene):
    controller = cr.Controller(ARM, cr.ControllerSettings())
    observer = cr.Observer(ARM, cr.ObserverSettings(), cr.ContactBudget())
    stack = cr.Stack(scene, controller=controller, observer=observer, planner=StayingCore())
    assert (stack.controller, stack.observer) == (controller, observer)
    planner = cr.Planner(ARM, StayingCore(), cr.ReplanningSettings(), cr.UnexpectedContactSettings())
    assert cr.Stack(scene, planner=planner).planner is planner
    with pytest.raises(cr.ContactReachError, match="planner is a Planner with settings of its own"):
        cr.Stack(scene, planner=planner, planning=cr.PlanningSettings())


@pytest.mark.parametrize(
    ("position", "others", "message"),
    [
        ([5.0, 0.0, 0.0], {}, "goal: position is .* the arm reaches 0.85 m"),
        ([0.0, 0.0, 0.2], {}, "goal: position = .* deep in lbr_link_0"),
        (NEAR, {"orientation": "up"}, "orientation = 'up'; expected"),
        (NEAR, {"orientation": [0.0, 0.0, 1.0, 1.0]}, "expected a unit quaternion"),
    ],
)
def test_goals_that_are_refused(stack, position, others, message):
    for method in (stack.plan, stack.run):
        with pytest.raises(cr.ContactReachError, match=message) as raised:
            method(cr.Goal(position, **others))
        assert "\n" not in str(raised.value)


def test_what_is_no_goal_is_refused(stack):
    for method in (stack.plan, stack.run, stack.command):
        with pytest.raises(cr.ContactReachError, match="goal is of type list; expected Goal"):
            method(NEAR)
    with pytest.raises(cr.ContactReachError, match="timeout = 0: expected a positive time"):
        stack.run(cr.Goal(NEAR), timeout=0)


def test_reset_releases_observer_controller_and_robot(stack):
    stack.settle()
    stack.observer.stop("pushed")
    stack.step()
    stack.step()
    assert stack.stop_reason == "pushed"
    stack.reset()
    stack.step()
    assert stack.stop_reason == ""
    stack.robot.stop("too fast")
    assert stack.stop_reason == "too fast"
    stack.reset()
    assert not stack.stop_reason
