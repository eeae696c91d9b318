"""The collision-free baseline in episodes: contact-free, within the method's bounds, planned once."""

import numpy as np
import pytest
from arm_simulation import ARM
from scipy.spatial.transform import Rotation

from benchmarks.baselines.collision_free import CollisionFreePlanner
from benchmarks.baselines.method import Method
from benchmarks.baselines.rrt_star import PathSettings, find_path
from benchmarks.episode import EpisodeOptions, run_episode
from contact_reach_ros.arm import link_frames
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.planning.settings import POSTURE_BOUND, ROTATION_BOUND, PlanningSettings
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene_file import read_scene

SETTINGS = PlanningSettings()
QUICK = PathSettings(searches=2, iterations=300, goal_samples=600)
GAINS = ImpedanceSettings()
AHEAD = 0.5 * GAINS.reference_ramp
"""References are from where the arm will be then, s."""


@pytest.mark.slow
def test_goal_behind_a_ball_is_reached_without_any_contact_within_the_methods_bounds():
    def search(arm, q, goal, spheres, seed):
        return find_path(arm, q, goal, spheres, QUICK, seed)

    scene, planner = make_scene(read_scene("ball"), ARM, 0), CollisionFreePlanner(ARM, SETTINGS, GAINS, search, 0)
    planner.warm_up(lambda line: None)
    result = run_episode(scene, Method(planner, ControllerSettings()), EpisodeOptions())
    assert result.reached and result.contact_forces.max() == 0.0
    # The way until then at the speed that the bounds permit.
    share = 1.0 + AHEAD * GAINS.task_stiffness / GAINS.task_damping
    slack = AHEAD * np.array(ARM.velocity_limits)
    for plan in result.plans:
        for knot, q in enumerate(plan.predicted_q[:-1]):
            rotations, origins = link_frames(ARM, q)
            turn = Rotation.from_matrix(plan.rotations[knot] @ rotations[-1].T).as_rotvec()
            assert np.abs(plan.positions[knot] - origins[-1]).max() <= share * SETTINGS.translation_bound
            assert np.abs(turn).max() <= share * ROTATION_BOUND
            assert (np.abs(plan.postures[knot] - q) <= POSTURE_BOUND + slack).all()
