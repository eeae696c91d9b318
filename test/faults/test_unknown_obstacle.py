"""An obstacle that the planner is not told of, with and without the observer's word about the contact."""

import numpy as np
from conftest import CONTROLLER, scene, small_planner

from benchmarks.baselines.method import Method
from benchmarks.episode import EpisodeOptions, run_episode
from benchmarks.episode_result import EpisodeResult
from contact_reach_ros.planning.settings import UnexpectedContactSettings
from contact_reach_ros.simulation.faults import UnknownObstacle
from contact_reach_ros.simulation.settings import WatchdogSettings


def episode(reaction: str) -> EpisodeResult:
    options = EpisodeOptions(
        settle=0.6,
        timeout=3.0,
        faults=(UnknownObstacle((0.512, -0.075, 0.125), stiffness=500.0, at=0.2),),
        watchdog=WatchdogSettings(),
        unexpected_contact=UnexpectedContactSettings(reaction=reaction),
    )
    return run_episode(scene("free"), Method(small_planner(), CONTROLLER), options)


def test_the_arm_that_retreats_touches_more_lightly_and_is_not_stopped():
    ignored, retreated = episode("ignore"), episode("retreat")
    assert "sudden external torque" in ignored.reasons["observer"]
    assert not retreated.reasons
    assert 5.0 < retreated.contact_forces.max() < 0.85 * ignored.contact_forces.max()
    assert retreated.contact_forces[-1] == 0.0
    # The flange waits where it went; with so small a budget of plans the elbow does not come to rest so soon.
    assert np.ptp(retreated.distances[-500:]) < 0.001
