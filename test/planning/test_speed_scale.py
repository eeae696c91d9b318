"""The share of its speed that a planner uses, changed while it plans."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import FLANGE, SMALL
from plans import StayingCore

from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.settings import ReplanningSettings, UnexpectedContactSettings
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.goal import Goal, Target
from contact_reach_ros.world.spheres import Spheres

REQUEST = Request(HOME, REST, 0, 0, Target(FLANGE + np.array([0.2, 0.1, -0.1])), Spheres.none())


def test_a_plan_from_rest_uses_exactly_the_share(planner):
    plan = planner.plan(REQUEST._replace(speed_scale=0.25))
    assert plan.speed_scale == 0.25
    moves = np.abs(plan.positions[0] - plan.predicted_positions[0])
    assert moves.max() == pytest.approx(0.25 * SMALL.translation_bound, rel=0.02)


def test_the_speed_changes_on_the_way(planner):
    stack = Stack(load_scene("free", arm=ARM), planner=planner)
    stack.settle()
    stack.command(Goal(stack.scene.target))
    speeds = []
    for stack.planner.speed_scale in (1.0, 0.2, 1.0):
        positions = []
        for _ in range(400):
            stack.step()
            positions.append(stack.tip_position)
        # What the speed was before has no effect any more.
        speeds.append(np.linalg.norm(positions[-1] - positions[200]))
    assert speeds[1] == pytest.approx(0.2 * speeds[0], rel=0.4)
    assert speeds[2] == pytest.approx(speeds[0], rel=0.4)


def test_a_core_that_cannot_slow_down_makes_no_plan():
    whole = Planner(ARM, StayingCore(), ReplanningSettings(), UnexpectedContactSettings())
    with pytest.raises(PlanningError, match=r"speed_scale = 1: expected 0\.5"):
        whole.solve(REQUEST._replace(speed_scale=0.5))
    assert whole.plan is None
    assert whole.solve(REQUEST) is whole.plan
