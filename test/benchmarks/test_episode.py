"""What an episode hands to the planner, and what it reports of the walls."""

import numpy as np
import pytest
from arm_simulation import ARM

from benchmarks.baselines.method import Method
from benchmarks.baselines.scripted import ScriptedPlanner
from benchmarks.episode import EpisodeOptions, run_episode
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import rest_positions


class WatchingPlanner(ScriptedPlanner):
    """Keeps the spheres it was shown."""

    def __init__(self, scene):
        super().__init__(scene)
        self.spheres = []

    def plan(self, request):
        self.spheres.append(request.spheres)
        return super().plan(request)


@pytest.mark.slow
def test_the_planner_sees_the_walls_give_way_and_pushing_through_is_felt():
    scene = make_scene(read_scene("wall"), ARM, 0)
    planner = WatchingPlanner(scene)
    options = EpisodeOptions(period=0.1, settle=0.6, timeout=6.0)
    result = run_episode(scene, Method(planner, ControllerSettings()), options)
    first, last = planner.spheres[0], planner.spheres[-1]
    np.testing.assert_allclose(first.center, rest_positions(scene), rtol=0, atol=1e-6)
    moved = np.linalg.norm(last.center - last.rest, axis=1)
    assert moved.max() > 0.01
    assert not moved[np.concatenate([wall.fixed for wall in scene.obstacles])].any()
    assert len(last.edges) == sum(len(wall.edges) for wall in scene.obstacles)
    assert result.contact_forces.max() > 2.0 and not result.contact_forces[:100].any()
    assert result.distances[-1] < result.distances[0]


def test_an_episode_until_rest_goes_on_until_the_tip_has_stayed_there_slowly():
    scene = make_scene(read_scene("free"), ARM, 1)

    options = EpisodeOptions(settle=0.6, timeout=9.0, tolerance=0.02, until_settled=True)
    resting = run_episode(scene, Method(ScriptedPlanner(scene), ControllerSettings()), options)
    assert resting.reached and resting.time == resting.settled > resting.duration + 0.2
    last = resting.positions[-201:]
    speeds = np.linalg.norm(np.diff(last, axis=0), axis=1) / 1e-3
    assert speeds.max() <= 0.01
    assert np.linalg.norm(last[1:] - scene.target, axis=1).max() <= 0.02
