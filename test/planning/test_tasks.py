"""What law (1) controls, with four to seven joints: model, variables and plans follow it."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, NO_FRICTION
from few_joints import few_joints
from planning_helpers import PERMITTED_FORCE, SMALL
from six_axis import SIX_AXIS

from benchmarks.model import simulate
from contact_reach_ros.arm import JointState, link_frames, tip_positions
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.kernels import Constant
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.planning.cost import ReferenceSpace
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import ReplanningSettings, UnexpectedContactSettings
from contact_reach_ros.planning.terms import Problem, term_weights
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.goal import Goal, Target
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

pytestmark = pytest.mark.usefixtures("quick_compilation")

UPPER_ARM = 1
"""The second of the two capsules on link_2 of the arm with six joints."""
POSE, AXIS, POSITION, AUTO = (
    ImpedanceSettings(task=task, reference_ramp=0.0) for task in ("pose", "position_and_axis", "position", "auto")
)
CASES = {
    "six joints, pose": (SIX_AXIS, POSE, 6),
    "six joints, position": (SIX_AXIS, POSITION, 3 + 6),
    "seven joints, position and axis": (ARM, AXIS, 5 + 7),
    "five joints, as much as they can hold": ("zyyzy", AUTO, 5),
    "four joints, as much as they can hold": ("zyyy", AUTO, 3 + 4),
}
QUICK = ("six joints, pose", "five joints, as much as they can hold")
LANES = 4
SIX_HOME, SIX_REST = np.array(SIX_AXIS.home), np.zeros(SIX_AXIS.n)


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[pytest.mark.slow] * (case not in QUICK)) for case in CASES],
)
def test_variables_are_what_has_an_effect_and_the_model_moves_as_the_arm_does(case):
    arm, gains, variables = CASES[case]
    arm = few_joints(arm) if isinstance(arm, str) else arm
    space = ReferenceSpace(arm, SMALL, gains)
    assert len(space.bounds) == SMALL.horizon * variables
    random = np.random.default_rng(0)
    starts = np.array(arm.home)[:, None] + random.uniform(-0.1, 0.1, (arm.n, LANES))
    problem = Problem(
        jnp.asarray(starts),
        jnp.zeros((arm.n, LANES)),
        None,
        jnp.zeros((3, 1)),
        jnp.eye(3)[:, :, None],
        term_weights(SMALL),
        PERMITTED_FORCE,
    )
    # Slow enough for the cap on joint speeds, which the model has; the other caps are lifted.
    points = random.uniform(-0.5, 0.5, (len(space.bounds), LANES))
    actions = np.asarray(space.actions(jnp.asarray(points), problem), float)
    assert (actions != 0.0).any(axis=(0, 2)).sum() == variables
    rollout = jax.jit(space.objective.roll_out)(problem, jnp.asarray(actions))
    constants = make_constants(arm, gains)
    constants[[Constant.TIP_FORCE, Constant.BODY_SPEED, Constant.IMPACT_ENERGY]] = 1e9
    for lane in range(LANES):
        scene = Scene("free", arm, 0, starts[:, lane], np.zeros(3))
        expected = simulate(scene, np.zeros(arm.n), actions[:, :, lane], gains=gains, constants=constants).joints[-1]
        moved = np.abs(expected - starts[:, lane]).max()
        # As for the iiwa with pose: the tip is predicted better than the null space.
        tip = tip_positions(arm, expected[None])[0]
        np.testing.assert_allclose(rollout.pose.position[-1, :, lane], tip, rtol=0, atol=1e-3)
        np.testing.assert_allclose(rollout.q[-1, :, lane], expected, rtol=0, atol=0.1 * moved)


def test_goals_keep_only_as_much_of_the_orientation_as_the_task_controls():
    state = JointState(0, SIX_HOME, SIX_REST, None)
    position = RobotModel(SIX_AXIS).tip_pose(state.q)[0] + np.array([0.0, 0.1, 0.0])

    def resolved(gains: ImpedanceSettings, *orientation: str) -> Target:
        planner = Planner(SIX_AXIS, None, ReplanningSettings(), UnexpectedContactSettings(), task=gains.task)
        return planner.resolve(Goal(position, *orientation), state)

    assert resolved(POSITION).rotation is None
    assert resolved(AXIS).only_axis and not resolved(AXIS, "free").only_axis
    assert resolved(POSE).rotation is not None and not resolved(POSE).only_axis


@pytest.fixture(scope="module")
def core() -> RecedingHorizonPlanner:
    """For an arm with another number of joints, asymmetric limits and other capsules, and one sphere."""
    return RecedingHorizonPlanner(SIX_AXIS, SMALL, ControllerSettings(AXIS), PERMITTED_FORCE, capacity=1)


@pytest.mark.slow
def test_a_task_of_position_and_axis_plans_for_the_axis_alone(core):
    position, rotation = RobotModel(SIX_AXIS).tip_pose(SIX_HOME)
    costs = {}
    for name, turn in {"none": np.zeros(3), "about": [0.0, 0.0, 1.0], "across": [0.3, 0.0, 0.0]}.items():
        goal = Target(position, rotation @ pin.exp3(np.array(turn)), only_axis=True)
        core.reset()
        plan = core.plan(Request(SIX_HOME, SIX_REST, 0, 10_000_000, goal, Spheres.none()))
        costs[name] = plan.cost_terms["orientation"]
        away = np.linalg.norm(link_frames(SIX_AXIS, plan.predicted_q[-1])[0][-1][:, 2] - goal.rotation[:, 2])
        # It turns as far in 0.3 s as the bounds permit.
        assert away < (0.2 if name == "across" else 0.01)
    assert costs["about"] == pytest.approx(costs["none"], abs=1e-4)
    assert costs["across"] > 0.01


@pytest.mark.slow
def test_plans_for_another_arm_lead_to_its_goal_and_predict_contact_as_in_the_simulation(core):
    """The ball is 7 mm deep in the upper arm, within what is permitted; forces on its two capsules add up."""
    goal = Target(RobotModel(SIX_AXIS).tip_pose(SIX_HOME)[0] + np.array([0.0, 0.1, 0.0]))
    starts, ends = capsule_segments(SIX_AXIS, SIX_HOME)
    settings = BallSettings(stiffness=5000.0, damping=500.0)
    reach = SIX_AXIS.capsules[UPPER_ARM].radius + settings.radius - 0.007
    balls = settings.at(0.5 * (starts + ends)[UPPER_ARM] + np.array([0.0, reach, 0.0]))
    scene = Scene("test", SIX_AXIS, 0, SIX_HOME, goal.position, balls)
    plant = Plant(scene, NO_FRICTION)
    for _ in range(30):
        plant.step()
    core.reset()
    spheres = obstacle_spheres(scene, rest_positions(scene))
    plan = core.plan(Request(SIX_HOME, SIX_REST, 0, 10_000_000, goal, spheres))
    assert plan.postures.shape == (SMALL.horizon, SIX_AXIS.n)
    distances = np.linalg.norm(plan.predicted_positions - goal.position, axis=1)
    assert distances[-1] < distances[0] - 0.005
    touching = plan.predicted_contact_forces
    assert touching.shape == (SMALL.horizon, len(SIX_AXIS.contact_links))
    assert np.flatnonzero(plant.contact_forces()).tolist() == np.flatnonzero(touching[0]).tolist() == [0]
    assert touching[0, 0] == pytest.approx(plant.contact_forces()[0], rel=0.15)
