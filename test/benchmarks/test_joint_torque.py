"""Planning joint torques, and applying them without any control law."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, ideal_plant

from benchmarks.baselines.joint_torque import HeldTorque, TorqueController, TorquePlanner, joint_damping, torque_step
from benchmarks.baselines.method import Method
from benchmarks.episode import EpisodeOptions, run_episode
from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.planning.cost import make_objective
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.simulation.plant import Actuation
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.scene import Scene

pytestmark = pytest.mark.slow

SETTINGS = PlanningSettings(deadline=0.0, population=48, horizon=2, max_steps=6)
GAINS, CONTROLLER = ImpedanceSettings(), ControllerSettings()
REST = np.zeros(ARM.n)
ROTATIONS, ORIGINS = link_frames(ARM, HOME)
GOAL = Target(ORIGINS[-1] + np.array([0.02, 0.06, -0.03]), ROTATIONS[-1])


def test_step_is_the_arms_motion_under_gravity_compensation_and_the_torque():
    plant = ideal_plant()
    plant.set_actuation(Actuation.COMMANDED)
    torque = np.array([4.0, -6.0, 3.0, 5.0, 0.4, -0.3, 0.2])
    system = make_objective(ARM, PlanningSettings(), GAINS).system
    state = pipeline.init(system, single(HOME[:, None]), single(REST[:, None]))
    for _ in range(4):
        state = torque_step(system, state, HeldTorque(single(torque[:, None]), None))
    model = RobotModel(ARM)
    for _ in range(100):
        reading = plant.read()
        model.update(reading.q, reading.v)
        plant.step(model.bias + torque)
    moved = plant.read().q - HOME
    assert np.abs(moved).max() > 0.01
    np.testing.assert_allclose(np.asarray(state.q)[:, 0] - HOME, moved, rtol=0.03, atol=1e-3)


def test_an_episode_gets_nearer_to_its_goal():
    planner = TorquePlanner(ARM, SETTINGS, CONTROLLER, 10.0, 0, joint_damping(ARM))
    planner.warm_up(lambda line: None)
    scene = Scene("free", ARM, 0, HOME, GOAL.position)
    method = Method(planner, CONTROLLER, TorqueController)
    # No law keeps the joints within the speed that the drive permits.
    options = EpisodeOptions(settle=0.6, timeout=1.0, watchdog=WatchdogSettings(speed_share=0.0))
    result = run_episode(scene, method, options)
    assert not result.stop_reason and not result.failure
    assert result.distances.min() < 0.5 * result.distances[0]
