"""The share of its speed that a planner uses, changed while it plans."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import SMALL
from plans import make_plan

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.stack import Stack
from contact_reach_ros.stack import make_planner as make_whole_planner
from contact_reach_ros.world.goal import Goal, Target
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres

FLANGE = link_frames(ARM, HOME)[1][-1]
GOAL = Target(FLANGE + np.array([0.2, 0.1, -0.1]))


def moves(planner, speed_scale: float) -> np.ndarray:
    plan = planner.plan(Request(HOME, np.zeros(ARM.n), 0, 0, GOAL, Spheres.none(), speed_scale))
    assert plan.speed_scale == speed_scale
    return np.abs(plan.positions[0] - plan.predicted_positions[0])


def test_a_plan_from_rest_uses_exactly_the_share(planner):
    found = moves(planner, 0.25)
    assert found.max() == pytest.approx(0.25 * SMALL.translation_bound, rel=0.02)


def test_the_speed_changes_on_the_way():
    def run_on(stack: Stack, ticks: int) -> float:
        start = stack.tip_position
        for _ in range(ticks):
            stack.step()
        return float(np.linalg.norm(stack.tip_position - start))

    stack = Stack(make_scene(read_scene("free"), ARM, 0), planning=SMALL)
    stack.settle()
    stack.command(Goal(stack.scene.target))
    run_on(stack, 300)
    full = run_on(stack, 200)
    stack.planner.speed_scale = 0.2
    run_on(stack, 150)
    slow = run_on(stack, 200)
    stack.planner.speed_scale = 1.0
    run_on(stack, 150)
    assert slow == pytest.approx(0.2 * full, rel=0.3)
    assert run_on(stack, 200) == pytest.approx(full, rel=0.3)
    assert stack.planner.plan.speed_scale == 1.0


def test_a_core_that_cannot_slow_down_makes_no_plan(planner):
    class Core:
        def plan(self, request):
            return make_plan(np.zeros((1, 3)), np.eye(3)[None], HOME[None])

    whole = make_whole_planner(ARM, 0, core=Core())
    request = Request(HOME, np.zeros(ARM.n), 0, 0, GOAL, Spheres.none())
    assert whole.solve(request) is whole.plan
    whole.plan = None
    with pytest.raises(PlanningError, match=r"speed_scale = 1: expected 0\.5"):
        whole.solve(request._replace(speed_scale=0.5))
    assert whole.plan is None
