"""A recording is shown as it was: moments, events and curves, also of bags that were not closed."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import MultiDOFJointTrajectory

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arms.iiwa14 import ARM
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.safety_state import ERROR
from contact_reach_ros.messages.values import goal_values
from contact_reach_ros.resources import share_directory
from contact_reach_ros.viewer.playback import Player
from contact_reach_ros.viewer.plots import quantities
from contact_reach_ros.viewer.recorded import Recording

SAMPLE = share_directory() / "bags" / "sample"
TICKS, START = 2000, 1000
GOAL = np.array([0.5, 0.1, 0.3])
REFUSED = np.array([2.0, 0.0, 0.0])
TYPES = {
    "/joint_states": JointState,
    "/external_torque": JointState,
    "/sim/contacts": JointState,
    "/goal_pose": PoseStamped,
    "/safety_state": DiagnosticStatus,
    "/reference/pose": MultiDOFJointTrajectory,
    "/plan/statistics": DiagnosticArray,
}


def joint_angles(tick):
    return np.array(ARM.home) + 1e-4 * tick


def messages():
    """(robot's time ns, topic, message) of two seconds: a goal, two contacts, a stop."""
    for tick in range(TICKS):
        stamp = Time(sec=START + tick // 1000, nanosec=tick % 1000 * 1_000_000)
        # The arm's joints in another order, and one more.
        names = [*reversed(ARM.joint_names), "gripper"]
        state = JointState(name=names, position=[*joint_angles(tick)[::-1].tolist(), 9.0], velocity=[0.0] * 8)
        state.header.stamp = stamp
        yield tick, "/joint_states", state
        torque = JointState(name=list(ARM.joint_names), effort=[0.001 * tick] * 7)
        torque.header.stamp = stamp
        yield tick, "/external_torque", torque
        if tick % 5 == 0:
            force = 4.0 if 600 <= tick < 700 or 1500 <= tick < 1510 else 0.0
            contact = JointState(name=["lbr_link_5", "sum", "max"], effort=[force] * 3)
            contact.header.stamp = stamp
            yield tick, "/sim/contacts", contact
        if tick in (300, 900):
            goal, place = PoseStamped(), GOAL if tick == 300 else REFUSED
            goal.pose.position.x, goal.pose.position.y, goal.pose.position.z = place.tolist()
            yield tick, "/goal_pose", goal
        if tick in (0, 1800):
            level = DiagnosticStatus.ERROR if tick else DiagnosticStatus.OK
            yield tick, "/safety_state", DiagnosticStatus(level=level, name="controller", message=f"said at {tick}")
        if tick % 50 == 0:
            plan = MultiDOFJointTrajectory()
            plan.header.stamp = stamp
            yield tick, "/reference/pose", plan
            if tick > 300:
                values = [KeyValue(key=key, value=f"{value:.6g}") for key, value in goal_values(GOAL).items()]
                yield (
                    tick,
                    "/plan/statistics",
                    DiagnosticArray(status=[DiagnosticStatus(name="planner", values=values)]),
                )


def write(folder):
    topics = {
        name: RecordedTopic(name, f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}")
        for name, kind in TYPES.items()
    }
    writer = BagWriter(folder, topics.values())
    for number, (tick, name, message) in enumerate(messages()):
        # In lockstep the wall's clock runs another way than the robot's.
        received = 5_000_000_000 + 3 * tick * 1_000_000 + number % 7
        writer.write(name, serialize_message(message), received)
    return writer


@pytest.fixture(scope="module", params=["closed", "not closed"])
def recording(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bag") / "bag"
    writer = write(folder)
    if request.param == "not closed":
        writer.flush()
        yield Recording(folder, ARM)
        writer.close()
    else:
        writer.close()
        yield Recording(folder, ARM)


def test_a_moment_is_shown_as_it_was(recording):
    assert recording.duration == pytest.approx(1.999) and len(recording.ticks) == TICKS
    frame = recording.frame(0.65)
    np.testing.assert_allclose(frame.q, joint_angles(650))
    np.testing.assert_allclose(frame.external_torque, 0.65)
    assert frame.forces["lbr_link_5"] == 4.0
    np.testing.assert_allclose(frame.goal, GOAL)
    assert frame.safety["controller"].message == "said at 0" and frame.safety["controller"].level != ERROR
    assert recording.frame(0.2).goal is None
    stopped = recording.frame(1.9)
    assert stopped.safety["controller"].level == ERROR
    assert stopped.safety["controller"].message == "said at 1800"


def test_obstacles_and_plan_are_those_of_the_moment():
    sample = Recording(SAMPLE, ARM)
    first_goal = next(event.time for event in sample.events if event.kind == "goal")
    before, after = sample.frame(first_goal - 0.1), sample.frame(first_goal + 0.5)
    assert before.plan is None and len(before.obstacles) == 1
    # The path begins near the flange of the moment for which it was planned.
    flange = link_frames(ARM, after.q)[1][-1]
    assert np.linalg.norm(after.plan.flange[0] - flange) < 0.03
    assert np.linalg.norm(after.plan.flange[-1] - after.goal) < np.linalg.norm(flange - after.goal)
    assert len(after.obstacles) == 1


def test_events_are_on_the_robots_clock(recording):
    found = [(event.kind, round(event.time, 2)) for event in recording.events]
    assert found == [("goal", 0.3), ("contact", 0.6), ("refused", 0.9), ("contact", 1.5), ("stop", 1.8)]
    assert next(event.time for event in recording.events if event.kind == "goal") == pytest.approx(0.3, abs=0.01)


def test_curves_have_the_values_of_their_time(recording):
    table = recording.table(recording.duration)
    columns = dict(zip(quantities(ARM.joint_names), table.T, strict=True))
    row = int(np.argmin(np.abs(columns["time"] - 1.0)))
    tick = round(1000 * columns["time"][row])
    flange = link_frames(ARM, joint_angles(tick))[1][-1]
    assert columns["distance"][row] == pytest.approx(1000.0 * np.linalg.norm(flange - GOAL), abs=0.01)
    assert columns["lbr_A3"][row] == pytest.approx(0.001 * tick)
    # A contact of 10 ms is shorter than the distance of the points, and is not lost.
    assert columns["force"][np.abs(columns["time"] - 1.51) < 0.05].max() == 4.0
    assert np.isnan(columns["distance"][columns["time"] < 0.29]).all()


def test_playing_stepping_and_jumping(recording):
    player = Player(recording)
    player.advance(1.0)
    assert player.time == 0.0
    player.toggle()
    player.speed = 0.5
    player.advance(0.4)
    assert player.time == pytest.approx(0.2)
    assert player.jump() and not player.playing and player.time == pytest.approx(0.6, abs=0.01)
    player.step(1)
    assert player.time == pytest.approx(0.601, abs=1e-9)
    player.step(-2)
    assert player.time == pytest.approx(0.599, abs=1e-9)
    assert player.jump() and player.jump() and not player.jump()
    player.seek(99.0)
    assert player.time == recording.duration
    player.toggle()
    assert player.playing and player.time == 0.0


def test_a_bag_without_joint_states_is_refused(tmp_path):
    writer = BagWriter(tmp_path / "bag", [RecordedTopic("/goal_pose", "geometry_msgs/msg/PoseStamped")])
    writer.write("/goal_pose", serialize_message(PoseStamped()), 1)
    writer.close()
    with pytest.raises(BagError, match="joint_states"):
        Recording(tmp_path / "bag", ARM)
