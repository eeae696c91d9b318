"""What happened to a goal: from accepted to settled, or to another end."""

import math

import numpy as np
import pytest
from arm_simulation import TICK_NS

from contact_reach_ros.planning.goal_progress import GoalPhase, GoalProgress
from contact_reach_ros.world.goal import Goal, Target

TARGET = Target(np.zeros(3), np.eye(3))
FAR, NEAR = np.array([0.1, 0.0, 0.0]), np.array([0.009, 0.0, 0.0])


def turned(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])


class TestProgress:
    @pytest.fixture
    def progress(self) -> GoalProgress:
        return GoalProgress(Goal(TARGET.position))

    def follow(self, progress, ticks, position=NEAR, angle=0.04, speed=0.009, target=TARGET):
        for tick in ticks:
            progress.update(target, position, turned(angle), speed, tick * TICK_NS)

    def test_it_is_reached_at_once_and_settled_after_a_while_at_rest(self, progress):
        progress.planned()
        self.follow(progress, [0], FAR)
        assert progress.state.phase is GoalPhase.RUNNING
        self.follow(progress, range(100, 300))
        assert progress.state.phase is GoalPhase.REACHED
        self.follow(progress, [300])
        assert progress.state.phase is GoalPhase.SETTLED
        assert progress.state.elapsed == pytest.approx(0.3)
        assert (progress.state.distance, progress.state.angle) == pytest.approx((0.009, 0.04))

    @pytest.mark.parametrize("unquiet", [{"position": FAR}, {"angle": 0.06}, {"speed": 0.011}])
    def test_whatever_is_unquiet_begins_the_wait_again(self, progress, unquiet):
        self.follow(progress, range(150))
        self.follow(progress, [150], **unquiet)
        self.follow(progress, range(151, 351))
        assert progress.state.phase is GoalPhase.REACHED
        self.follow(progress, [351])
        assert progress.state.phase is GoalPhase.SETTLED

    def test_a_tip_at_rest_holds_after_a_while_at_the_goal_until_it_moves_or_leaves(self, progress):
        self.follow(progress, range(500), speed=0.02)
        self.follow(progress, [499])
        assert not progress.holds
        self.follow(progress, [500])
        assert progress.holds
        self.follow(progress, [501], speed=0.02)
        assert not progress.holds
        self.follow(progress, [502], FAR)
        self.follow(progress, range(503, 1003))
        assert not progress.holds
        self.follow(progress, [1003])
        assert progress.holds

    def test_it_stays_settled_when_the_arm_is_pushed_away_and_its_time_stands_still(self, progress):
        self.follow(progress, range(201))
        self.follow(progress, [3000], FAR)
        assert progress.state.phase is GoalPhase.SETTLED
        assert (progress.state.elapsed, progress.state.distance) == pytest.approx((0.2, 0.1))
