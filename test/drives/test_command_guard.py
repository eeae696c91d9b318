"""The watchdog before a drive that has none: commands pass, silence brings harmless torques, then a latched stop."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS, TORQUE_LIMITS, UNWATCHED, ideal_plant, references_of

from contact_reach_ros.arm import REST_SPEED, JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.kernels import Constant
from contact_reach_ros.control.references import Reference
from contact_reach_ros.drives.command_guard import CommandGuard, Phase
from contact_reach_ros.drives.settings import AdapterSettings
from contact_reach_ros.errors import InputError, StopCode
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.simulation.settings import WatchdogSettings

GRAVITY = RobotModel(ARM).gravity_at(HOME)
FLOATING = AdapterSettings(gravity_compensation=False)


class Bench:
    """A guard with an arm that stands still, ticked at 1 kHz."""

    def __init__(self, settings=AdapterSettings()):  # noqa: B008
        self.guard = CommandGuard(ARM, settings)
        self.now_ns = 5_000_000_000

    def see(self, velocity=REST):
        self.guard.see(JointState(self.now_ns, HOME, np.asarray(velocity), None), self.now_ns)

    def command(self, torque=GRAVITY):
        return self.guard.command(torque, self.now_ns)

    def tick(self, count=1, velocity=REST, states=True):
        """What the guard itself sends in each tick."""
        sent = []
        for _ in range(count):
            self.now_ns += TICK_NS
            if states:
                self.see(velocity)
            sent.append(self.guard.watch(self.now_ns))
        return sent


@pytest.fixture
def bench():
    made = Bench()
    made.see()
    return made


def test_nothing_is_sent_before_the_first_command(bench):
    assert bench.tick(500) == [None] * 500
    assert bench.guard.phase is Phase.WAITING and not bench.guard.stop_reason


def test_commands_pass_at_once_as_they_are(bench):
    for _ in range(50):
        np.testing.assert_array_equal(bench.command(2.0 * GRAVITY), 2.0 * GRAVITY)
        assert bench.tick(20) == [None] * 20


def test_silence_brings_the_harmless_torque_and_then_a_latched_stop(bench):
    bench.command()
    sent = bench.tick(150)
    assert [torque is None for torque in sent] == [True] * 20 + [False] * 130
    np.testing.assert_allclose(sent[-1], GRAVITY, atol=1e-9)
    assert bench.guard.stop_reason == "no command for 102 ms"
    assert bench.guard.stop_reason.code is StopCode.NO_COMMAND
    assert bench.command() is None
    assert bench.tick()[0] is not None


def test_without_joint_states_there_are_no_commands_which_the_stop_says(bench):
    bench.command()
    bench.tick(150, states=False)
    assert bench.guard.stop_reason == "no command for 102 ms, nothing on joint_states for 102 ms: see the driver"


@pytest.mark.parametrize(
    ("torque", "message"),
    [
        (np.zeros(6), "adapter/commands: data has 6 values; expected 7"),
        (np.full(7, np.nan), "expected finite torques"),
        (1.01 * TORQUE_LIMITS, "expected at most"),
    ],
)
def test_a_command_that_is_none_is_refused_and_counts_as_silence(bench, torque, message):
    bench.command()
    for _ in range(150):
        with pytest.raises(InputError, match=message):
            bench.command(torque)
        bench.tick()
    assert bench.guard.stop_reason


@pytest.mark.parametrize(
    ("settings", "carried"),
    [(AdapterSettings(), GRAVITY), (FLOATING, REST)],
    ids=["raw", "carries itself"],
)
def test_harmless_torques_damp_and_carry_only_where_they_must(settings, carried):
    bench = Bench(settings)
    bench.see()
    bench.command(carried)
    velocity = np.array([0.05, 0, 0, 0, 0, 0, 0])
    torque = bench.tick(35, velocity)[-1]
    rate, model = make_constants(ARM)[Constant.STOP_RATE, 0], RobotModel(ARM)
    model.update_dynamics(HOME)
    np.testing.assert_allclose(torque, carried - rate * model.mass_matrix @ velocity, atol=1e-9)
    # By an old velocity it would be driven.
    np.testing.assert_allclose(bench.tick(80, states=False)[-1], carried, atol=1e-9)


@pytest.mark.parametrize("settings", [AdapterSettings(), FLOATING])
def test_an_encoder_that_is_set_anew_hardly_kicks_a_stopped_arm(settings):
    """Harmless torques press with no more than twice what they hold."""
    bench, jumped = Bench(settings), HOME + 2.0 * np.pi * (np.arange(ARM.n) == 0)
    bench.see()
    bench.command(GRAVITY * settings.gravity_compensation)
    bench.tick(500)
    carried = GRAVITY * settings.gravity_compensation
    for _ in range(500):
        bench.now_ns += TICK_NS
        bench.guard.see(JointState(bench.now_ns, jumped, REST, None), bench.now_ns)
        extra = np.abs(bench.guard.watch(bench.now_ns) - carried)
        assert (extra <= 2.0 * np.array(ARM.default("handover_thresholds"))).all()


@pytest.mark.parametrize("silence", [50, 200])
def test_after_a_silence_commands_come_back_by_and_by(bench, silence):
    bench.command()
    bench.tick(silence)
    if bench.guard.stop_reason:
        bench.guard.reset(bench.now_ns)
        assert bench.guard.phase is Phase.HARMLESS
        # However long they take to come.
        assert all(torque is not None for torque in bench.tick(300)) and not bench.guard.stop_reason
    command = GRAVITY + 10.0
    passed = []
    for _ in range(502):
        passed.append(bench.command(command))
        assert bench.tick() == [None]
    np.testing.assert_allclose(passed[0], GRAVITY, atol=1e-9)
    assert np.abs(np.diff(passed, axis=0)).max() <= 10.0 / 500 + 1e-9
    np.testing.assert_array_equal(passed[-1], command)


def test_a_stop_is_reset_only_at_rest_and_in_sight(bench):
    bench.command()
    bench.guard.stop("button")
    bench.guard.stop("another")
    assert bench.guard.stop_reason == "button" and bench.guard.phase is Phase.HARMLESS
    bench.tick(velocity=np.full(7, 0.1))
    with pytest.raises(InputError, match=r"0\.100 rad/s; reset needs at most 0\.05"):
        bench.guard.reset(bench.now_ns)
    bench.tick(200, states=False)
    with pytest.raises(InputError, match="ms old; reset needs one of the last 75 ms"):
        bench.guard.reset(bench.now_ns)
    assert bench.guard.stop_reason == "button"
    bench.tick()
    bench.guard.reset(bench.now_ns)
    assert not bench.guard.stop_reason


def displacement_after_silence(is_guarded):
    """How far the joints move, rad, in half a second after a moving controller ended; their speed then, rad/s."""
    plant = ideal_plant()
    watchdog = WatchdogSettings(enabled=False, speed_share=0.0)
    robot = SimulatedRobot(plant.scene, watchdog, plant=plant, open_after=0.0)
    controller, guard = Controller(ARM, UNWATCHED), CommandGuard(ARM, AdapterSettings())
    ended = None
    for tick in range(1, 900):
        now_ns, reading = tick * TICK_NS, plant.read()
        state = reading._replace(stamp_ns=now_ns, torque=None)
        guard.see(state, now_ns)
        sent = None
        if tick < 400:
            sent = guard.command(controller.update(state, now_ns), now_ns)
            if tick == 1:
                position, rotation = controller.model.tip_pose(HOME)
                there = Reference(position + np.array([0.0, 0.2, 0.0]), rotation, HOME)
                controller.follow(references_of([there], 2 * TICK_NS, (1000 * TICK_NS,)))
        elif is_guarded:
            sent = guard.watch(now_ns)
        if tick == 400:
            ended, speed = plant.data.qpos.copy(), np.abs(plant.data.qvel).max()
            assert speed > 0.2, "the arm does not move: the test shows nothing"
        if sent is not None:
            robot.command(sent, now_ns)
        robot.step(now_ns)
    return np.abs(plant.data.qpos - ended).max(), np.abs(plant.data.qvel).max()


def test_a_drive_without_a_watchdog_goes_on_and_with_the_guard_the_arm_comes_to_rest():
    runaway, fast = displacement_after_silence(is_guarded=False)
    caught, slow = displacement_after_silence(is_guarded=True)
    assert runaway > 0.1 and fast > 0.2
    assert caught < 0.05 and slow < REST_SPEED
