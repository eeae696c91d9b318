"""An obstacle that the planner is not told of, with and without the observer's word about the contact."""

from typing import NamedTuple

import numpy as np
from conftest import CONTROLLER, scene, small_planner

from benchmarks.faulty_robot import FaultyRobot, UnknownObstacle
from contact_reach_ros.observer.observer import LEAST_FORCE
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.planning.settings import GIVE_WAY, IGNORE, UnexpectedContactSettings
from contact_reach_ros.stack import Result, Stack
from contact_reach_ros.world.goal import Goal


class Run(NamedTuple):
    """How it ended, and the force on the arm after each millisecond from the goal on, N."""

    result: Result
    goal: GoalState
    forces: np.ndarray


def run(reaction: str) -> Run:
    hidden = UnknownObstacle((0.512, -0.075, 0.123), stiffness=500.0, at=0.2)
    robot, forces = FaultyRobot(scene("free"), (hidden,)), []
    settings = UnexpectedContactSettings(reaction=reaction)
    stack = Stack(
        scene("free"), controller=CONTROLLER, unexpected_contact=settings, planner=small_planner(), robot=robot
    )
    stack.settle()
    robot.start_faults()
    result = stack.run(Goal(scene("free").target), 3.0, lambda _: forces.append(robot.contact_forces().max()))
    return Run(result, stack.planner.goal_state, np.array(forces))


def test_the_arm_that_gives_way_touches_lightly_and_is_not_stopped():
    ignored, gave_way = run(IGNORE), run(GIVE_WAY)
    assert ignored.result.stop_reason.startswith("contact of") and "gave way" in ignored.result.stop_reason
    assert not gave_way.result.stop_reason and gave_way.goal.phase is GoalPhase.WITHDRAWN
    assert gave_way.goal.reason.startswith("unexpected contact of")
    forces = gave_way.forces
    touched = int(np.flatnonzero(forces)[0])
    assert LEAST_FORCE < forces.max() < 0.5 * ignored.forces.max()
    # It gives way soon, and what is left does not count: the arm then rests against the obstacle.
    assert forces.argmax() - touched < 200
    assert forces[touched + 700 :].max() < LEAST_FORCE
