"""The share of its speed that a planner uses, changed while it plans."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import SMALL

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.node_settings import ReplanningSettings
from contact_reach_ros.stack import Stack
from contact_reach_ros.stack import make_planner as make_whole_planner
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.generate import make_scene
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres
from contact_reach_ros.world.task import Goal

FLANGE = link_frames(ARM, HOME)[1][-1]
GOAL = Target(FLANGE + np.array([0.2, 0.1, -0.1]))


def moves(planner, effect_ms: int) -> np.ndarray:
    plan = planner.plan(HOME, np.zeros(ARM.n), effect_ms * 1_000_000, effect_ms * 1_000_000, GOAL, Spheres.none())
    return np.abs(plan.positions[0] - plan.predicted_positions[0])


def test_a_plan_from_rest_uses_exactly_the_share(planner):
    planner.limit_speed(0.25)
    found = moves(planner, 0)
    planner.limit_speed(1.0)
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


def test_a_stack_slows_down_and_still_arrives():
    scene = make_scene(read_scene("free"), ARM, 0)
    speeds = {}
    for scale in (1.0, 0.5):
        stack = Stack(scene, planning=SMALL, replanning=ReplanningSettings(speed_scale=scale, require_obstacles=False))
        positions = []
        result = stack.run(
            Goal(scene.target), watch=lambda tick, stack=stack, found=positions: found.append(stack.tip_position)
        )
        assert result.reached
        speeds[scale] = np.linalg.norm(positions[600] - positions[300])
    assert speeds[0.5] == pytest.approx(0.5 * speeds[1.0], rel=0.15)


def test_a_core_that_cannot_slow_down_makes_no_plan(planner):
    class Core:
        def plan(self, *request):
            raise AssertionError

    whole = make_whole_planner(ARM, 0, core=Core())
    whole.speed_scale = 0.5
    with pytest.raises(PlanningError, match=r"speed_scale = 0\.5: expected 1"):
        whole.solve((None,) * 6)
