"""Signals of a made-up episode come back out of its bag as they went in."""

from pathlib import Path

import numpy as np
import pytest
from arm_simulation import ARM
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arm import tip_positions
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import EpisodeSignals, arm_of_bag, goal_distance, read_signals, settings_of_bag
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.messages.goal_state import to_goal_state
from contact_reach_ros.messages.intake import IntakeLog, Taken
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState

RECEIVED_0 = 1_700_000_000_000_000_000
STAMP_0 = 50_000_000_000
TICKS = 400
SLOWNESS = 3.0
"""Time on the wall that a second of the robot's clock takes, as in lockstep on a busy machine."""

TYPES = {
    "joint_states": "sensor_msgs/msg/JointState",
    "external_torque": "sensor_msgs/msg/JointState",
    "sim/contacts": "sensor_msgs/msg/JointState",
    "effort_controller/commands": "std_msgs/msg/Float64MultiArray",
    "goal_pose": "geometry_msgs/msg/PoseStamped",
    "safety_state": "diagnostic_msgs/msg/DiagnosticStatus",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "goal/state": "diagnostic_msgs/msg/DiagnosticStatus",
    "plan/statistics": "diagnostic_msgs/msg/DiagnosticArray",
}
GOALS = {50: 0.5, 200: 2.0, 300: 0.7}
"""Places, x in m, by tick; that in the middle is refused."""


def received_ns(time: float) -> int:
    return RECEIVED_0 + round(SLOWNESS * time * 1e9)


def stamped(time: float, names: list[str], **values: list[float]) -> JointState:
    message = JointState(name=names, **values)
    stamp = STAMP_0 + round(time * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return message


def angles(time: float) -> np.ndarray:
    return np.sin(time + np.arange(7))


def write_episode(directory: Path) -> None:
    shuffled = [3, 1, 0, 6, 5, 4, 2]
    names = [ARM.joint_names[joint] for joint in shuffled]
    with BagWriter(directory, [RecordedTopic(f"/{name}", type_name) for name, type_name in TYPES.items()]) as writer:

        def write(topic: str, time: float, message: object) -> None:
            writer.write(f"/{topic}", serialize_message(message), received_ns(time))

        for tick in range(TICKS):
            time = tick * 1e-3
            q = angles(time)[shuffled].tolist()
            order, velocity = (["gripper", *names], [9.0, *q]) if tick % 2 else (names, q)
            write("joint_states", time, stamped(time, order, position=velocity, velocity=velocity, effort=velocity))
            write("effort_controller/commands", time, Float64MultiArray(data=angles(time).tolist()))
            write("external_torque", time, stamped(time, names, effort=q))
            bodies = ["lbr_link_3", "sum", "max"] if tick < 200 else ["lbr_link_4", "sum", "max"]
            write("sim/contacts", time, stamped(time, bodies, effort=[2.0, 3.0, 2.0]))
            if tick % 20 == 0:
                bad = 100 <= tick < 200
                level = DiagnosticStatus.ERROR if bad else DiagnosticStatus.OK
                text = "joint A2 above threshold" if bad else "monitoring"
                write("safety_state", time, DiagnosticStatus(level=level, name="observer", message=text))
            if tick in GOALS:
                message = to_goal_pose([GOALS[tick], 0.0, 0.0], "lbr_link_0", Time())
                write("goal_pose", time, message)
                phase = GoalPhase.REFUSED if tick == 200 else GoalPhase.ACCEPTED
                # All goals have the stamp 0.
                write("goal/state", time, to_goal_state(GoalState(phase), 0, "planner", ARM))
            if tick == 350:
                write("goal/state", time, to_goal_state(GoalState(GoalPhase.SETTLED), 0, "planner", ARM))
            if tick % 100 == 0:
                values = [KeyValue(key="ticks", value=str(tick)), KeyValue(key="state", value="active")]
                write("diagnostics", time, DiagnosticArray(status=[DiagnosticStatus(name="driver", values=values)]))


@pytest.fixture(scope="module")
def signals(tmp_path_factory: pytest.TempPathFactory) -> EpisodeSignals:
    directory = tmp_path_factory.mktemp("episode") / "bag"
    write_episode(directory)
    return read_signals(BagReader(directory), ARM)


def test_joint_states_are_mapped_by_name(signals: EpisodeSignals) -> None:
    expected = np.array([angles(tick * 1e-3) for tick in range(TICKS)])
    assert signals.position.names == ARM.joint_names
    for series in (signals.position, signals.velocity, signals.effort, signals.external_torque):
        np.testing.assert_allclose(series.values, expected)
    np.testing.assert_allclose(signals.position.column("lbr_A3"), expected[:, 2])


def test_all_times_are_on_the_clock_of_the_robot(signals: EpisodeSignals) -> None:
    """Also those of messages without a stamp, though three times as much time passes on the wall."""
    expected = np.arange(TICKS) * 1e-3
    assert signals.clock.origin_ns == STAMP_0
    for series in (signals.position, signals.external_torque, signals.contact_force, signals.command):
        np.testing.assert_allclose(series.time, expected, atol=1e-7)


def test_behind_an_adapter_the_torques_are_the_controllers(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for name, torque in (("effort_controller/commands", 2.0), ("adapter/commands", 1.0)):
            writer.add_topic(RecordedTopic(f"/{name}", TYPES["effort_controller/commands"]))
            writer.write(f"/{name}", serialize_message(Float64MultiArray(data=[torque] * 7)), RECEIVED_0)
    assert read_signals(BagReader(tmp_path / "bag"), ARM).command.values.tolist() == [[1.0] * 7]


def test_goals_are_where_they_were_sent_without_those_that_were_refused(signals: EpisodeSignals) -> None:
    assert signals.goals.time == pytest.approx([0.05, 0.3], abs=1e-7)
    np.testing.assert_array_equal(signals.goals.values, [[0.5, 0.0, 0.0], [0.7, 0.0, 0.0]])
    np.testing.assert_array_equal(signals.refused_goals.values, [[2.0, 0.0, 0.0]])
    assert signals.settled == pytest.approx([0.35], abs=1e-7)


def test_safety_changes_without_repetitions(signals: EpisodeSignals) -> None:
    seen = [(event.level, event.message) for event in signals.safety]
    assert seen == [(0, "monitoring"), (2, "joint A2 above threshold"), (0, "monitoring")]
    assert [event.time for event in signals.safety] == pytest.approx([0.0, 0.1, 0.2], abs=1e-7)


def test_distance_is_to_the_goal_in_force(signals: EpisodeSignals) -> None:
    found = goal_distance(signals, ARM, period=0.01)
    time, distance = found.time, found.column("distance")
    assert np.diff(time)[:-1] == pytest.approx(0.01, abs=1e-6)
    assert time[-1] == signals.position.time[-1]
    goals = np.outer(np.where(time < 0.3 - 1e-6, 0.5, 0.7), [1.0, 0.0, 0.0])
    tips = tip_positions(ARM, np.array([angles(moment) for moment in time]))
    np.testing.assert_allclose(distance, np.linalg.norm(tips - goals, axis=1), atol=1e-6)


def test_topics_of_other_types_are_left_out(tmp_path: Path) -> None:
    topics = [RecordedTopic(f"/{name}", "std_msgs/msg/Float64MultiArray") for name in ("goal_pose", "settings")]
    with BagWriter(tmp_path / "bag", topics) as writer:
        for topic in topics:
            writer.write(topic.name, serialize_message(Float64MultiArray(data=[1.0])), RECEIVED_0)
    bag = BagReader(tmp_path / "bag", of_stack=True)
    signals = read_signals(bag, arm_of_bag(bag))
    assert not len(signals.goals.time) and not settings_of_bag(bag)


@pytest.mark.parametrize(
    ("topic", "data"), [("plan/statistics", b"\0\1\0\0\1"), ("diagnostics", b"\0\1\0\0" + b"\1" * 20)]
)
def test_statuses_that_cannot_be_read_are_counted(tmp_path: Path, topic: str, data: bytes) -> None:
    with BagWriter(tmp_path / "bag", [RecordedTopic(f"/{topic}", TYPES[topic])]) as writer:
        for _ in range(3):
            writer.write(f"/{topic}", data, RECEIVED_0)
    bag = BagReader(tmp_path / "bag")
    read_signals(bag, ARM)
    assert bag.notes == (f"topic '/{topic}': 3 messages are left out, no {TYPES[topic]} of ROS 2 Jazzy in CDR",)


def test_round_trips_are_of_states_that_were_answered(tmp_path: Path) -> None:
    """The first state comes again until the controller starts, which takes it a second."""
    types = {**TYPES, "intake/controller": "std_msgs/msg/Int64MultiArray"}
    with BagWriter(tmp_path / "bag", [RecordedTopic(f"/{name}", kind) for name, kind in types.items()]) as writer:
        log = IntakeLog(lambda data: writer.write("/intake/controller", data, RECEIVED_0))
        for tick in range(1000):
            q = angles(0.0).tolist()
            state = stamped(tick * 1e-3, list(ARM.joint_names), position=q, velocity=q, effort=q)
            sent_ns = RECEIVED_0 + tick * 1_000_000
            writer.write("/joint_states", serialize_message(state), sent_ns)
            log.add(Taken.JOINT_STATES, sent_ns, tick)
            if tick >= 900:
                log.outputs += 1
                data = serialize_message(Float64MultiArray(data=q))
                writer.write("/effort_controller/commands", data, sent_ns + 300_000, sequence=log.outputs)
        log.flush()
    signals = read_signals(BagReader(tmp_path / "bag"), ARM)
    np.testing.assert_array_equal(signals.answers_ns, np.full(100, 300_000))


@pytest.mark.parametrize(("prefix", "effort"), [("", []), ("left_", [0.5] * 7)])
def test_states_without_torques_or_of_another_robot_leave_gaps(tmp_path: Path, prefix: str, effort: list) -> None:
    q, names = angles(0.0).tolist(), [f"{prefix}{name}" for name in ARM.joint_names]
    with BagWriter(tmp_path / "bag", [RecordedTopic("/joint_states", TYPES["joint_states"])]) as writer:
        state = stamped(0.0, names, position=q, velocity=q, effort=effort)
        writer.write("/joint_states", serialize_message(state), RECEIVED_0)
    signals = read_signals(BagReader(tmp_path / "bag"), ARM)
    np.testing.assert_array_equal(signals.position.values, [q if not prefix else [np.nan] * 7])
    assert np.isnan(signals.effort.values).all()
    assert any("has none of the joints lbr_A1" in note for note in signals.notes) is bool(prefix)


def test_messages_without_a_number_for_each_joint_are_counted(tmp_path: Path) -> None:
    q, names = angles(0.0).tolist(), list(ARM.joint_names)
    commands = "effort_controller/commands"
    with BagWriter(
        tmp_path / "bag", [RecordedTopic(f"/{name}", TYPES[name]) for name in ("joint_states", commands)]
    ) as to:
        for tick, position in enumerate([q, [float("nan"), *q[1:]], q]):
            state = stamped(tick * 1e-3, names, position=position, velocity=q, effort=q)
            to.write("/joint_states", serialize_message(state), RECEIVED_0 + tick)
            torques = Float64MultiArray(data=q[: 6 + tick])
            to.write(f"/{commands}", serialize_message(torques), RECEIVED_0 + tick)
        gripper = stamped(2e-3, ["finger"], position=[0.0], velocity=[], effort=[])
        to.write("/joint_states", serialize_message(gripper), RECEIVED_0 + 3)
    notes = read_signals(BagReader(tmp_path / "bag"), ARM).notes
    for name in ("joint_states", commands):
        assert f"{name}: at least 1 messages lack a number for one of the arm's 7 joints" in notes
