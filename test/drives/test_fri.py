"""KUKA's arm behind both generations of its driver: recognised, read without its filters, checked, and moved."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from arm_simulation import ARM
from kuka import CONFIGS, LATER, OF_2024, Adapted, KukaRobot, described
from plans import StayingCore, make_plan

from contact_reach_ros.arms import make_settings
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.drives.command_guard import Phase
from contact_reach_ros.drives.fri import FriStates, read_driver
from contact_reach_ros.drives.settings import LbrSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.safety_state import read_in_force
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.presets import SECTIONS
from contact_reach_ros.resources import config_file
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.settings import parameters_in
from contact_reach_ros.stack import Stack
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import Goal

SCENE = load_scene("free")
GOALS = [0.51, 0.025, 0.145], [0.45, -0.3, 0.35]
FAR_MOVED = 0.005
"""m, from which on an arm that should not has moved."""


def description(generation, **config):
    return described(CONFIGS[generation] | config)


@pytest.mark.parametrize(("generation", "named"), [(OF_2024, "of 2024"), (LATER, "later than 2024")])
def test_both_generations_are_recognised_by_their_hardware_parameters(generation, named):
    driver = read_driver(description(generation), True)
    assert driver.generation == named
    # 10 Hz and 0.1 s in steps of 2 ms.
    assert driver.torque_share(0.002) == pytest.approx({OF_2024: 0.1179, LATER: 0.0198}[generation], abs=1e-3)


@pytest.mark.parametrize(
    ("text", "fri", "words"),
    [
        (description(OF_2024, open_loop="True"), 1, "set open_loop: false in lbr_system_config.yaml"),
        (description(OF_2024, client_command_mode="position"), 1, "client_command_mode is position; expected torque"),
        (description(LATER, client_command_mode="wrench"), 1, "client_command_mode is wrench; expected torque"),
        (description(OF_2024, pid_p=0.0), 1, "expected pid_p above 0"),
        (description(OF_2024, pid_i=0.1), 1, "pid_i and pid_d 0"),
        (description(OF_2024, measured_torque_cutoff_frequency=0), 1, "expected more than 0 Hz"),
        (description(LATER, measured_torque_tau="fast"), 1, "measured_torque_tau is fast; expected a number"),
        (description(OF_2024), 2, "of 2024 with FRI 2"),
        (description(LATER).replace("measured_torque_tau", "torque_smoothing"), 1, "expected measured_torque_cutoff"),
        (
            description(LATER).replace("lbr_ros2_control::SystemInterface", "mock_components/GenericSystem"),
            1,
            "hardware",
        ),
        ("<robot", 1, "not valid XML"),
    ],
)
def test_another_driver_and_each_wrong_setting_are_named(text, fri, words):
    with pytest.raises(InputError, match=words):
        read_driver(text, fri == 1)
    states = FriStates(ARM, LbrSettings(), 0.002)
    states.describe(text, fri == 1)
    states.read(fri_message(1), 0)
    assert words.split(";")[0] in states.problem and not states.expect_commands()


def test_a_later_driver_overrides_open_loop_itself():
    assert read_driver(description(LATER, open_loop="true"), False).generation == "later than 2024"


def fri_message(step, torque=(0.0,) * 7, q=(0.0,) * 7, **fields):
    seconds, rest = divmod(step * 2_000_000, NANOSECONDS)
    return SimpleNamespace(
        **{
            "sample_time": 0.002,
            "session_state": 4,
            "connection_quality": 3,
            "client_command_mode": 3,
            "control_mode": 2,
            "time_stamp_sec": seconds,
            "time_stamp_nano_sec": rest,
            "measured_joint_position": q,
            "commanded_joint_position": q,
            "measured_torque": torque,
            **fields,
        }
    )


@pytest.mark.parametrize("generation", [OF_2024, LATER])
def test_the_drivers_filter_is_undone_exactly_from_the_second_state_on(generation):
    share = read_driver(description(generation), True).torque_share(0.002)
    torques = np.random.default_rng(0).normal(40.0, 20.0, (200, 7))
    states, filtered = FriStates(ARM, LbrSettings(torque_sign="negative"), 0.002, True), np.zeros(7)
    states.describe(description(generation), True)
    for step, torque in enumerate(torques, 1):
        filtered = filtered + share * (torque - filtered)
        read = states.read(fri_message(step, -filtered), 0).torque
        np.testing.assert_allclose(read, np.nan if step == 1 else torque, rtol=1e-9)


def test_over_missing_states_the_torque_is_a_mean_of_those_that_acted():
    share = read_driver(description(LATER), True).torque_share(0.002)
    states, filtered = FriStates(ARM, LbrSettings(), 0.002, True), np.zeros(7)
    states.describe(description(LATER), True)
    for step, torque in zip(range(1, 7), (5.0, 5.0, 6.0, 7.0, 8.0, 9.0), strict=True):
        filtered = filtered + share * (torque - filtered)
        read = states.read(fri_message(step, filtered), 0) if step in (1, 2, 6) else None
    # The weights differ by a few per cent.
    np.testing.assert_allclose(read.torque, 7.5, atol=0.05)


def test_torques_are_unknown_without_the_drivers_settings():
    states = FriStates(ARM, LbrSettings(), 0.002, True)
    assert all(np.isnan(states.read(fri_message(step), 0).torque).all() for step in (1, 2, 3))
    assert states.problem.startswith("no lbr/robot_description yet")


def test_a_controller_manager_that_is_slower_than_fri_is_named():
    states = FriStates(ARM, LbrSettings(), 0.002, True)
    states.describe(description(LATER), True)
    for step in range(1, 3000, 5):
        states.read(fri_message(step), 0)
    assert states.problem.startswith("states come every 10.0 ms, FRI sends every 2 ms: set update_rate")


@pytest.mark.parametrize("generation", [OF_2024, LATER])
def test_the_commanded_position_stays_at_an_arm_that_moves_fast(generation):
    states, far = FriStates(ARM, LbrSettings(), 0.002, True), []
    states.describe(description(generation), True)
    commanded = np.zeros(7)
    for step in range(1, 1000):
        q = np.full(7, 0.5 * (1.0 - np.cos(0.008 * step)))
        states.read(fri_message(step, q=q, commanded_joint_position=commanded), 0)
        far.append(np.abs(commanded - q).max())
        target = states.position_for(np.zeros(7))
        share = 1.0 - np.exp(-0.002 / 0.04)
        commanded = commanded + (0.1 * (target - q) if generation == OF_2024 else share * (target - commanded))
    # At 2 rad/s it would lag behind by 0.08 rad.
    assert max(far) < 0.005


def behind_adapter(generation, stiffness=0.0, period=0.002, **config):
    return Adapted(KukaRobot(SCENE, period, generation, stiffness, **config))


def asked_for(robot, seconds):
    """Have commands come for a time, none of which may be needed."""
    while robot.robot.plant.time < seconds:
        robot.step(robot.robot.now_ns)
        robot.read()
        try:
            robot.command(np.zeros(7), robot.robot.now_ns)
        except InputError:
            continue
    return robot


@pytest.mark.parametrize(
    ("generation", "fri", "period"), [(OF_2024, 1, 0.002), (LATER, 1, 0.002), (LATER, 2, 0.002), (LATER, 1, 0.005)]
)
def test_a_stiffness_that_is_not_zero_is_found_before_a_command_is_passed_on(generation, fri, period):
    robot = asked_for(behind_adapter(generation, 200.0, period, fri=fri), 1.6)
    assert "stiffness of about" in robot.problem and "JointImpedanceControlMode(0, 0," in robot.problem
    assert robot.guard.phase is Phase.HARMLESS and robot.moved < FAR_MOVED and not robot.robot.ended
    measured = float(robot.problem.partition("about ")[2].split()[0])
    assert 150.0 < measured < 250.0


@pytest.mark.parametrize(
    ("generation", "fri", "period"), [(OF_2024, 1, 0.001), (OF_2024, 1, 0.002), (LATER, 1, 0.002), (LATER, 2, 0.002)]
)
def test_without_stiffness_the_check_does_not_move_the_arm_and_commands_pass(generation, fri, period):
    robot = asked_for(behind_adapter(generation, 0.0, period, fri=fri), 1.3)
    assert not robot.problem and robot.guard.phase is Phase.PASSING
    assert robot.moved < 0.001 and not robot.robot.ended


def test_a_position_that_is_not_commanded_is_named():
    robot = behind_adapter(LATER)
    robot.robot.aim = lambda position: None
    asked_for(robot, 1.6)
    assert "does not follow: activate lbr_torque_command_controller" in robot.problem
    del robot.robot.aim
    assert "does not follow" in asked_for(robot, 3.0).problem
    robot.states.reset()
    assert not asked_for(robot, 4.6).problem


def test_after_a_pause_of_the_states_or_with_another_driver_the_stiffness_is_measured_again():
    robot = asked_for(behind_adapter(LATER), 1.3)
    robot.states.read(fri_message(10_000), 0)
    assert "has not been measured yet" in robot.states.problem
    robot = asked_for(behind_adapter(LATER), 1.3)
    robot.states.describe(described(CONFIGS[LATER] | {"measured_torque_tau": 0.02}), True)
    robot.states.read(fri_message(10_001), 0)
    assert "has not been measured yet" in robot.states.problem


def test_the_same_description_again_changes_nothing():
    robot = asked_for(behind_adapter(LATER), 1.3)
    before = robot.states.problem
    robot.states.describe(robot.robot.description, True)
    assert robot.states.problem == before and not robot.states.expect_commands() and robot.states.has_states


def test_a_new_session_is_checked_again():
    robot = asked_for(behind_adapter(LATER), 1.3)
    session = robot.robot.message()["session_state"]
    robot.states.read(fri_message(10_000, session_state=2), 0)
    assert robot.states.problem.startswith("the FRI session is MONITORING_READY")
    robot.states.read(fri_message(10_001, session_state=session), 0)
    assert "has not been measured yet" in robot.states.problem


class LineCore(StayingCore):
    """Plans straight to the goal, 12 cm/s, from where the last plan led to; nothing has to be compiled."""

    STEP, AHEAD, KNOTS = 0.012, 0.0036, 5
    """m in a knot and from plan to plan, and number of knots."""

    def __init__(self):
        super().__init__()
        self._there = None

    def plan(self, request):
        goal, q = request.goal.position, request.q
        tip, rotation = self.model.tip_pose(q)
        if self._there is None or np.linalg.norm(self._there - tip) > 0.03:
            self._there = tip.copy()
        positions = [self._there]
        for _ in range(self.KNOTS):
            positions.append(self._towards(positions[-1], goal, self.STEP))
        self._there = self._towards(self._there, goal, self.AHEAD)
        rotation = rotation if request.goal.rotation is None else request.goal.rotation
        rotations, postures = np.repeat(rotation[None], self.KNOTS, 0), np.repeat(q[None], self.KNOTS, 0)
        return make_plan(np.array(positions[1:]), rotations, postures, effect_ns=request.effect_ns)

    def _towards(self, position, goal, step):
        return position + (goal - position) * min(1.0, step / max(np.linalg.norm(goal - position), 1e-9))


class BehindAdapter(Stack):
    """The stack with config/lbr.yaml, whose controller hears from the adapter whether commands pass."""

    def __init__(self, robot, scene=None):
        """`scene`: what the stack takes for the robot's; by default that one."""
        scene = scene or robot.robot.scene
        file, arm = config_file("lbr.yaml"), scene.arm
        chosen = {
            node: make_settings(parameters_in(file, node), SECTIONS[node], arm, str(file))
            for node in ("controller", "observer")
        }
        controller = ControllerSettings.from_sections(chosen["controller"])
        supervision = dataclasses.replace(controller.supervision, adapter=True)
        super().__init__(
            scene,
            planner=LineCore(),
            controller=dataclasses.replace(controller, supervision=supervision),
            observer=ObserverSettings.from_sections(chosen["observer"]),
            robot=robot,
            period=robot.robot.period,
        )

    def _control(self):
        phase = SimpleNamespace(key="state", value=self.robot.guard.phase.value)
        message = SimpleNamespace(name="adapter", values=[phase])
        self.controller.in_force = read_in_force(message, self.controller.in_force)
        return super()._control()


@pytest.mark.parametrize("phase", Phase)
def test_commands_are_in_force_only_while_they_pass(phase):
    """Others may move the arm while it gets harmless torques: nothing must pull it back."""
    state = [SimpleNamespace(key="state", value=phase.value)]
    for before in (False, True):
        assert read_in_force(SimpleNamespace(name="adapter", values=state), before) == (phase is Phase.PASSING)
        assert read_in_force(SimpleNamespace(name="driver", values=state), before) == before


@pytest.mark.parametrize(
    ("generation", "config", "period"),
    [
        pytest.param(OF_2024, {}, 0.002, marks=pytest.mark.slow),
        pytest.param(OF_2024, {"measured_torque_cutoff_frequency": 1.6}, 0.001, marks=pytest.mark.slow),
        pytest.param(LATER, {}, 0.002, marks=pytest.mark.slow),
        (LATER, {"measured_torque_tau": 0.016}, 0.002),
    ],
)
def test_two_goals_settle_within_a_millimetre_without_a_false_contact(generation, config, period):
    stack = BehindAdapter(behind_adapter(generation, 0.0, period, **config))
    stack.settle(2.0)
    assert not stack.robot.problem
    for goal in GOALS:
        result = stack.run(Goal(goal), until_settled=True)
        assert result.settled and result.distance < 0.001, result
    assert not stack.robot.robot.ended and stack.observer.monitor.contacts == 0


@pytest.mark.slow
@pytest.mark.parametrize(("tau", "settles"), [(0.016, True), (0.1, False)])
def test_a_filter_of_torques_that_the_driver_does_not_tell_is_harmless_or_ends_the_motion_at_once(tau, settles):
    """Of 10 Hz and of 1.6 Hz; the latter looks like contact, which the goal is lost for."""
    robot = behind_adapter(LATER, measured_torque_tau=tau)
    robot.states.describe(described(CONFIGS[LATER] | {"measured_torque_tau": 0.0}), True)
    for _ in range(500):
        robot.robot.step(robot.robot.now_ns)
    stack = BehindAdapter(robot)
    stack.settle(2.0)
    result = stack.run(Goal(GOALS[0]), until_settled=True)
    assert result.settled == settles
    reason = stack.planner.goal_state.reason
    assert settles or (robot.moved < FAR_MOVED and "unexpected" in reason and "measured_torque_tau" in reason)
