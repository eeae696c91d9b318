"""What the adapter makes of the messages of KUKA's and Franka's drivers, and what it asks of the other nodes."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from kuka import CONFIGS, LATER, OF_2024, KukaRobot, described
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from stack_helpers import hand_in, ros
from std_msgs.msg import String
from test_adapter import Bench

from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.drives import command_guard, effort, franka, lbr
from contact_reach_ros.drives.command_guard import Phase
from contact_reach_ros.drives.settings import (
    FRANKA_TORQUE_RATE,
    AdapterSettings,
    EffortSettings,
    FrankaSettings,
    LbrSettings,
)
from contact_reach_ros.errors import InputError, SettingsError, StopCode
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.resources import config_file
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.settings import parameters_in
from contact_reach_ros.timing import NANOSECONDS

ARM = load_arm("iiwa14")
MS = NANOSECONDS // 1000
START_NS = 500 * NANOSECONDS
"""Of the robot's clock; this machine's is AHEAD_NS ahead of it."""
AHEAD_NS = 1000 * NANOSECONDS


class Node:
    """Clients whose services are there, and answer at once what they are told to, or never."""

    def __init__(self, answer=None, is_simulated=False):
        self.answer, self.asked, self.warned, self.forgotten = answer, [], [], 0
        self.parameters = {"use_sim_time": SimpleNamespace(value=is_simulated)}

    def get_parameter(self, name):
        return self.parameters[name]

    def create_client(self, kind, name):
        self.asked_for = name
        return self

    def service_is_ready(self):
        return True

    def call_async(self, request):
        self.asked.append(request)
        answers = self.answer is not None
        future = SimpleNamespace(result=lambda: self.answer, done=lambda: answers)
        future.add_done_callback = lambda callback: callback(future) if answers else None
        return future

    def remove_pending_request(self, future):
        self.forgotten += 1

    def get_logger(self):
        return SimpleNamespace(info=lambda line: None, warning=self.warned.append, error=lambda line: None)


pytestmark = pytest.mark.usefixtures("packages")


def make_lbr(node=None, is_described=True, **settings):
    target = lbr.LbrTarget(node or Node(), ARM, LbrSettings(**settings), 0.002)
    if is_described:
        target.states.describe(described(CONFIGS[LATER]), True)
    return target


def message(tick=1, **fields):
    stamp_ns = START_NS + 2 * tick * MS
    values = {"sample_time": 0.002, "session_state": 4, "connection_quality": 3, "client_command_mode": 3}
    stamp = {"time_stamp_sec": stamp_ns // NANOSECONDS, "time_stamp_nano_sec": stamp_ns % NANOSECONDS}
    return lbr.LBRState(**{**values, **stamp, "measured_torque": np.arange(7.0), **fields})


def test_stamps_have_the_robots_steps_on_this_machines_clock():
    target, stamps = make_lbr(), []
    for tick, late_ms in enumerate([3, 1, 7, 2, 9, 1, 30, 1]):
        arrives_ns = START_NS + AHEAD_NS + (2 * tick + late_ms) * MS
        stamps.append(target.states.read(message(tick), arrives_ns).stamp_ns)
    # The first message was late; after the best one the steps are the robot's, but for the drift that is allowed for.
    assert stamps[1] == START_NS + AHEAD_NS + 3 * MS
    np.testing.assert_allclose(np.diff(stamps[1:]), 2 * MS, rtol=5e-4)
    # One that comes twice is no new state.
    assert target.states.read(message(7), START_NS + AHEAD_NS + 16 * MS) is None
    # A simulated clock is everybody's.
    assert make_lbr(Node(is_simulated=True)).states.read(message(), 0).stamp_ns == START_NS + 2 * MS
    # This machine's clock is set.
    set_ns = START_NS - AHEAD_NS + 16 * MS
    assert target.states.read(message(8), set_ns).stamp_ns == set_ns


def test_velocity_is_that_of_the_positions():
    target, speed = make_lbr(velocity_cutoff=100.0), np.linspace(-1.0, 1.0, 7)
    for tick in range(100):
        state = target.states.read(
            message(tick, measured_joint_position=0.002 * tick * speed), START_NS + 2 * tick * MS
        )
    np.testing.assert_allclose(state.v, speed, atol=1e-9)
    np.testing.assert_allclose(state.q, 0.002 * 99 * speed)
    # After a pause nobody knows it.
    state = target.states.read(message(1000, measured_joint_position=speed), START_NS + 2000 * MS)
    np.testing.assert_allclose(state.v, 0.0)


@pytest.mark.parametrize(("sign", "factor"), [("positive", 1.0), ("negative", -1.0)])
def test_commands_mirror_the_measured_position_and_measured_torques_have_the_sign_of_the_setting(sign, factor):
    target, q = make_lbr(torque_sign=sign), np.linspace(0.1, 0.7, 7)
    for tick in (1, 2):
        state = target.states.read(message(tick, measured_joint_position=q), START_NS)
    np.testing.assert_allclose(factor * state.torque, range(7), atol=1e-9)
    sent = deserialize_message(target.write(np.arange(7.0)), lbr.LBRTorqueCommand)
    assert sent.joint_position.tolist() == q.tolist() and sent.torque.tolist() == list(range(7))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"session_state": 2}, "the FRI session is MONITORING_READY"),
        ({"connection_quality": 1}, "the FRI connection is FAIR"),
        ({"client_command_mode": 1}, "FRI takes POSITION"),
        ({"sample_time": 0.005}, "FRI sends every 5 ms"),
    ],
)
def test_a_driver_that_is_not_ready_is_explained_and_gives_states_nevertheless(fields, words):
    target = make_lbr()
    assert "no state on lbr/state yet" in target.problem
    assert target.states.read(message(1, **fields), START_NS) is not None
    assert target.problem.startswith(words)
    target.states.read(message(2), START_NS)
    assert "stiffness of KUKA's joint impedance control has not been measured" in target.problem


def test_a_stop_deactivates_the_component_unless_it_has_no_name():
    node = Node()
    make_lbr(node, driver="left").stop()
    assert node.asked_for == "left/controller_manager/set_hardware_component_state"
    assert node.asked[0].name == "lbr_system_interface" and node.asked[0].target_state.label == "inactive"
    silent = Node()
    make_lbr(silent, component="").stop()
    assert silent.asked == []


@pytest.mark.parametrize(
    ("carries", "brakes", "switches"), [(True, False, False), (True, True, True), (False, False, True)]
)
def test_a_stop_deactivates_the_effort_controller_unless_the_arm_would_drop(carries, brakes, switches, monkeypatch):
    node, settings = Node(), EffortSettings(ask_joints=False, brakes=brakes)
    target = effort.EffortTarget(node, ARM, settings, carries)
    target.stop()
    target.resume(False)
    target.resume(True)
    asked = [(list(each.activate_controllers), list(each.deactivate_controllers)) for each in node.asked]
    assert asked == ([([], ["effort_controller"]), (["effort_controller"], [])] if switches else [])
    monkeypatch.setattr(effort, "SwitchController", None)
    effort.EffortTarget(node, ARM, settings, carries).stop()
    assert len(node.asked) == len(asked)
    assert any(line.startswith("controller_manager_msgs is not installed") for line in node.warned) == switches


@pytest.mark.parametrize(
    ("states", "idle"),
    [
        ({"effort_controller": "active"}, ""),
        ({"effort_controller": "inactive", "another": "active"}, "effort_controller is inactive"),
        # That of another controller manager.
        ({"another": "active"}, ""),
    ],
)
def test_torques_reach_an_arm_whose_effort_controller_is_active(states, idle):
    listed = [SimpleNamespace(name=name, state=state, claimed_interfaces=[]) for name, state in states.items()]
    target = effort.EffortTarget(Node(SimpleNamespace(controller=listed)), ARM, EffortSettings(ask_joints=False), True)
    assert not target.idle
    target.look()
    assert target.idle == idle


def test_the_controller_manager_knows_a_controller_without_its_namespace():
    node = Node()
    effort.EffortTarget(node, ARM, EffortSettings(controller="left/effort_controller", ask_joints=False), False).stop()
    assert node.asked_for == "left/controller_manager/switch_controller"
    assert list(node.asked[0].deactivate_controllers) == ["effort_controller"]


def test_another_order_of_joints_after_a_restart_counts(monkeypatch):
    monkeypatch.setattr(effort, "ListControllers", None)
    node = Node()
    target = effort.EffortTarget(node, ARM, EffortSettings(), True)
    monkeypatch.setattr(target, "_find_elsewhere", lambda: "")
    for order in (ARM.joint_names, ARM.joint_names[::-1]):
        node.answer = SimpleNamespace(values=[SimpleNamespace(string_array_value=order)])
        target.look()
        assert target.order == order and not target.problem
    assert target.write(np.arange(7.0)) == target._writer.write(np.arange(7.0)[::-1])


def test_nothing_passes_while_another_controller_commands_the_drive():
    def listed(own, other):
        states = {"joint_state_broadcaster": "active", "effort_controller": own, "trajectories": other}
        claimed = {"trajectories": ["lbr_A1/effort"]}
        return SimpleNamespace(
            controller=[
                SimpleNamespace(name=name, state=state, claimed_interfaces=claimed.get(name, []))
                for name, state in states.items()
            ]
        )

    node = Node(listed("inactive", "active"))
    target = effort.EffortTarget(node, ARM, EffortSettings(ask_joints=False), True)
    target.look()
    assert target.problem == (
        "effort_controller is inactive; the drive is commanded by trajectories: ros2 control switch_controllers -c "
        "controller_manager --activate effort_controller --deactivate trajectories"
    )
    node.answer = listed("active", "inactive")
    target.look()
    assert not target.problem


def test_a_gripper_keeps_its_controller():
    def controller(name, state, *claims):
        return SimpleNamespace(name=name, state=state, claimed_interfaces=claims)

    gripper = controller("gripper_controller", "active", "finger_joint/position")
    for other in (("chained", "admittance/lbr_A3/effort"), ("plain", "lbr_A3/effort")):
        listed = [controller("effort_controller", "inactive"), gripper, controller(other[0], "active", other[1])]
        target = effort.EffortTarget(
            Node(SimpleNamespace(controller=listed)), ARM, EffortSettings(ask_joints=False), True
        )
        target.look()
        assert target.problem.endswith(f"--activate effort_controller --deactivate {other[0]}")


def test_a_reset_needs_a_controller_that_is_active_or_that_it_activates():
    listed = [SimpleNamespace(name="effort_controller", state="inactive", claimed_interfaces=[])]
    for carries, may_reset in ((True, False), (False, True)):
        target = effort.EffortTarget(
            Node(SimpleNamespace(controller=listed)), ARM, EffortSettings(ask_joints=False), carries
        )
        target.look()
        with contextlib.nullcontext() if may_reset else pytest.raises(InputError, match="--activate effort_controller"):
            target.check_reset()


def test_a_controller_without_joints_is_named(monkeypatch):
    monkeypatch.setattr(effort, "ListControllers", None)
    target = effort.EffortTarget(Node(SimpleNamespace(values=[])), ARM, EffortSettings(), True)
    monkeypatch.setattr(target, "_find_elsewhere", lambda: "")
    target.look()
    assert "takes commands for the joints none" in target.problem


def test_torques_reach_a_kuka_in_a_commanding_session_until_its_component_is_deactivated():
    target = make_lbr(Node(SimpleNamespace(ok=True)))
    for session, idle in (
        (3, "the FRI session is COMMANDING_WAIT"),
        (4, ""),
        (1, "the FRI session is MONITORING_WAIT"),
    ):
        target.states.read(message(session, session_state=session), START_NS)
        assert target.idle == idle
    target.states.read(message(9), START_NS)
    target.stop()
    assert target.idle == "lbr_system_interface is inactive"


def test_fri_is_refused_where_it_is_too_slow_for_torques():
    with pytest.raises(SettingsError, match="state_rate = 200 Hz; expected 500 to 1000, an FRI send period"):
        lbr.LbrTarget(Node(), ARM, LbrSettings(), 0.005)


def test_a_missing_message_package_is_named():
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(lbr, "LBRState", None)
        patched.setattr(franka, "SetFullCollisionBehavior", None)
        with pytest.raises(SettingsError, match="lbr_fri_idl is not installed; build lbr_fri_ros2_stack"):
            make_lbr()
        with pytest.raises(SettingsError, match="franka_msgs is not installed; build franka_ros2"):
            make_franka()
        assert "effort_controller" in make_franka(set_reflexes=False).problem


@pytest.mark.parametrize("kind", ["lbr", "franka"])
def test_an_adapter_for_an_arm_that_carries_itself_does_not_carry_it(kind):
    with ros(f"kind:={kind}"), pytest.raises(SettingsError, match="gravity_compensation = true"):
        AdapterNode()


@pytest.fixture
def bench(monkeypatch):
    """An adapter for KUKA's driver, whose loop runs when told to, on a machine that may be busy meanwhile."""
    monkeypatch.setattr(command_guard, "HOLD_AFTER", 0.5)
    monkeypatch.setattr(command_guard, "STOP_AFTER", 1.0)
    with ros("kind:=lbr", "gravity_compensation:=false", "state_rate:=500.0"):
        yield Bench()


class BenchOnKuka:
    """KUKA's arm behind an adapter whose loop runs when told to."""

    def __init__(self, bench, **config):
        self.node, self.bench = bench.node, bench
        self.robot = KukaRobot(load_scene("free"), 0.002, **config)
        self.sent, self.states = [], []
        self.node._write, self.node._write_state = self._take, self._forward
        self.describe(self.robot.description)

    def describe(self, text):
        hand_in(self.node.inbox, self.node._target._description, serialize_message(String(data=text)))

    def run(self, seconds, commands=True, **fields):
        """Exchange states and commands; `fields` are other values of the states."""
        for _ in range(round(500 * seconds)):
            self.robot.step(self.robot.now_ns)
            state = lbr.LBRState(**self.robot.message() | fields)
            hand_in(self.node.inbox, self.node._target._source, serialize_message(state))
            if commands:
                self.bench.command(np.zeros(7))
            self.node._look_for_silence()

    def _take(self, data):
        command = deserialize_message(data, lbr.LBRTorqueCommand)
        self.sent.append(command.torque.tolist())
        self.robot.aim(command.joint_position)
        self.robot.command(command.torque, self.robot.now_ns)

    def _forward(self, data):
        self.states.append(deserialize_message(data, JointState))
        hand_in(self.node.inbox, topics.JOINT_STATES, data)


def test_commands_pass_when_the_stiffness_is_known_to_be_zero_until_the_session_ends(bench):
    kuka, node = BenchOnKuka(bench), bench.node
    kuka.run(0.1)
    assert kuka.sent == [] and "COMMANDING_WAIT" in node.diagnosis()[0]
    kuka.run(0.5, commands=False)
    assert kuka.sent == [] and "has not been measured" in node.diagnosis()[0]
    kuka.run(0.5)
    assert "is being measured" in node.diagnosis()[0] and node._guard.phase is Phase.HARMLESS and len(kuka.sent) > 200
    kuka.run(0.7)
    assert node._guard.phase is Phase.PASSING and not node.diagnosis()[0]
    kuka.run(0.1, session_state=1)
    assert node._guard.stop_reason.startswith("the FRI session is MONITORING_WAIT")
    assert node._guard.stop_reason.code is StopCode.DRIVE
    # The arm carries itself: at rest nothing is harmless.
    assert np.abs(kuka.sent[-1]).max() < 0.5 and len(kuka.states) > 900


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"stiffness": 200.0}, "stiffness of about"),
        ({"generation": OF_2024, "stiffness": 200.0}, "stiffness of about"),
        ({"generation": OF_2024, "open_loop": "true"}, "set open_loop: false"),
        ({"client_command_mode": "position"}, "client_command_mode is position; expected torque"),
    ],
)
def test_a_wrong_setting_is_named_and_no_command_passes(bench, config, words):
    kuka = BenchOnKuka(bench, **config)
    start = kuka.robot.plant.tip_position
    kuka.run(1.7)
    assert words in bench.node.diagnosis()[0] and bench.node._passed == 0
    assert np.linalg.norm(kuka.robot.plant.tip_position - start) < 0.005


def test_a_driver_in_another_namespace_is_named(bench):
    keep = bench.publish(bench.node._target._source._replace(name="left/lbr/state"))
    bench.until(lambda: bench.node._target.look() or "there is /left/lbr/state" in bench.node.diagnosis()[0], "found")
    assert "set lbr.driver to what comes before /state" in bench.node.diagnosis()[0]
    bench.other.destroy_publisher(keep)


def test_a_cutoff_of_the_observer_is_refused_as_torques_come_unfiltered():
    assert make_lbr().hear("observer", {"momentum.torque_cutoff": 10.0}).startswith("momentum.torque_cutoff = 10")
    assert not make_lbr().hear("observer", {"momentum.torque_cutoff": 0.0})


def test_a_controller_that_does_not_know_of_the_delay_is_refused():
    said = make_lbr().hear("controller", {"limits.torque_delay": 0.0})
    assert said.startswith("limits.torque_delay = 0 s in the controller; expected at least 0.0093 s")
    file = parameters_in(config_file("lbr.yaml"), "controller")
    assert file["limits.torque_delay"] and not make_lbr().hear("controller", file)


def make_franka(node=None, **settings):
    return franka.FrankaTarget(node or Node(), ARM, FrankaSettings(**settings))


def test_nothing_passes_before_the_reflexes_are_set(monkeypatch):
    monkeypatch.setattr(effort, "ListControllers", None)
    node = Node(franka.SetFullCollisionBehavior.Response(success=True))
    target = make_franka(node)
    target._take_order(ARM.joint_names)
    target._question = None
    assert target.problem.startswith("the reflexes are not set yet")
    target.look()
    (request,) = node.asked
    assert not target.problem and target.diagnosis() == {"reflexes": "set"}
    assert request.lower_torque_thresholds_nominal.tolist() == list(franka.REFLEX_TORQUES)
    assert request.upper_force_thresholds_acceleration.tolist() == [60.0] * 3 + [30.0] * 3
    target.look()
    assert len(node.asked) == 1
    # A driver that was started again has its own.
    node.service_is_ready = lambda: False
    target.look()
    assert target.problem.startswith("the reflexes are not set yet")
    node.service_is_ready = lambda: True
    target.look()
    assert not target.problem and len(node.asked) == 2


@pytest.mark.parametrize(
    ("node", "settings", "words"),
    [
        ("controller", {"limits.torque_rate": 4000.0}, "limits.torque_rate = 4000 in the controller"),
        ("observer", {"budget.torque_thresholds": [30.0] * 5 + [28.0, 8.0]}, "the reflex of lbr_A5 comes at 29 Nm"),
        ("observer", {"budget.torque_thresholds": [30.0, 30.0, 25.0, 25.0, 15.0, 10.0, 8.0]}, ""),
    ],
)
def test_settings_that_the_arm_would_cut_short_are_named(node, settings, words):
    said = make_franka().hear(node, settings)
    assert said.startswith(words) and bool(said) == bool(words)


def test_harmless_torques_change_no_faster_than_the_arm_follows():
    settings = AdapterSettings(kind="franka", gravity_compensation=False)
    assert torque_rates(ARM, settings.limits).max() <= FRANKA_TORQUE_RATE


def test_a_request_whose_answer_is_lost_is_sent_again(monkeypatch):
    now, client = [100.0], Node()
    monkeypatch.setattr(effort.time, "monotonic", lambda: now[0])
    repeated = effort.RepeatedRequest(client, lambda answer: None)
    for now[0] in (100.0, 101.9, 102.1, 103.0, 104.2):
        repeated.send("request")
    assert len(client.asked) == 3 and client.forgotten == 2
