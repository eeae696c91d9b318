"""A recording is shown as it was: moments, events and curves."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message

from contact_reach_ros.arm import link_frames
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import read_signals
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.safety_state import ERROR
from contact_reach_ros.resources import share_directory
from contact_reach_ros.viewer import recorded
from contact_reach_ros.viewer.playback import Player
from contact_reach_ros.viewer.plots import quantities
from contact_reach_ros.viewer.recorded import Recording

SAMPLE = share_directory() / "bags" / "sample"
SENT, REACHES, REFUSED, TOUCHED = 0.502, 1.1, 2.0, 2.5
"""When the goal is sent, the arm touches the ball, another goal is refused, and the arm is touched for 10 ms, s."""


@pytest.fixture(scope="module")
def signals():
    """Those of the sample bag, with a refused goal and one more contact."""
    found = read_signals(BagReader(SAMPLE), ARM)
    force = found.contact_force
    values = force.values.copy()
    values[force.time > 1.9] = 0.0
    values[(force.time >= TOUCHED) & (force.time < TOUCHED + 0.01)] = 4.0
    refused = dataclasses.replace(found.goals, time=np.array([REFUSED]), values=np.array([[2.0, 0.0, 0.0]]))
    return dataclasses.replace(found, contact_force=dataclasses.replace(force, values=values), refused_goals=refused)


@pytest.fixture(scope="module")
def recording(signals):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorded, "read_signals", lambda *_: signals)
        return Recording(SAMPLE)


def test_a_moment_is_shown_as_it_was(recording, signals):
    assert recording.duration == pytest.approx(signals.position.time[-1])
    frame = recording.frame(1.5)
    for shown, series in ((frame.q, signals.position), (frame.external_torque, signals.external_torque)):
        np.testing.assert_array_equal(shown, series.values[series.time <= 1.5 + 1e-9][-1])
    force = signals.contact_force.between(0.0, 1.5)
    assert frame.forces["lbr_link_5"] == force.column("lbr_link_5")[-1]
    np.testing.assert_array_equal(frame.goal, signals.goals.values[0])
    assert recording.frame(SENT - 0.1).goal is None
    assert frame.safety["controller"].message == "tracking"
    stopped = recording.frame(recording.duration).safety["controller"]
    assert stopped.level == ERROR and stopped.message == "stop service called"


def test_obstacles_and_plan_are_those_of_the_moment(recording):
    before, after = recording.frame(SENT - 0.1), recording.frame(SENT + 0.5)
    assert before.plan is None and len(before.obstacles) == len(after.obstacles) == 1
    # The path begins near the flange of the moment for which it was planned.
    flange = link_frames(ARM, after.q)[1][-1]
    assert np.linalg.norm(after.plan.flange[0] - flange) < 0.03
    assert np.linalg.norm(after.plan.flange[-1] - after.goal) < np.linalg.norm(flange - after.goal)


def test_events_are_on_the_robots_clock(recording):
    found = [(event.kind, round(event.time, 3)) for event in recording.events]
    assert found == [("goal", SENT), ("contact", REACHES), ("refused", REFUSED), ("contact", TOUCHED), ("stop", 3.044)]


def test_curves_have_the_values_of_their_time(recording, signals):
    columns = dict(zip(quantities(ARM.joint_names), recording.table(recording.duration).T, strict=True))
    row = int(np.argmin(np.abs(columns["time"] - 1.0)))
    frame = recording.frame(columns["time"][row])
    flange = link_frames(ARM, frame.q)[1][-1]
    assert columns["distance"][row] == pytest.approx(1000.0 * np.linalg.norm(flange - frame.goal), abs=0.01)
    assert columns["lbr_A3"][row] == frame.external_torque[2]
    # A contact of 10 ms is shorter than the distance of the points, and is not lost.
    assert columns["force"][np.abs(columns["time"] - TOUCHED) < 0.1].max() == 4.0
    assert np.isnan(columns["distance"][columns["time"] < SENT - 0.01]).all()


def test_playing_stepping_and_jumping(recording):
    player = Player(recording)
    assert player.time == pytest.approx(SENT, abs=0.01)
    player.seek(0.0)
    assert player.frame(1.0).time == 0.0
    player.toggle()
    player.speed = 0.5
    assert player.frame(0.4).time == pytest.approx(0.2)
    player.jump()
    assert not player.playing and player.time == pytest.approx(REACHES, abs=1e-3)
    here = player.time
    player.step(1)
    assert player.time == pytest.approx(here + 0.001)
    player.step(-2)
    assert player.time == pytest.approx(here - 0.001)
    for _ in range(3):
        player.jump()
    assert player.time == pytest.approx(TOUCHED)
    player.seek(99.0)
    assert player.time == recording.duration
    player.toggle()
    assert player.playing and player.time == 0.0


@pytest.mark.parametrize("off", [5.0, -5.0, 3600.0])
def test_a_state_with_a_wrong_stamp_is_left_out_alone(off):
    times = np.arange(100.0)
    times[40] += off + 0.5
    assert recorded._increasing(times).tolist() == [place for place in range(100) if place != 40]


def test_repeated_states_are_no_moments():
    times = np.repeat(np.arange(50.0), 2)
    assert np.diff(times[recorded._increasing(times)]).tolist() == 49 * [1.0]


def test_a_bag_without_joint_states_is_refused(tmp_path):
    writer = BagWriter(tmp_path / "bag", [RecordedTopic("/goal_pose", "geometry_msgs/msg/PoseStamped")])
    writer.write("/goal_pose", serialize_message(PoseStamped()), 1)
    writer.close()
    with pytest.raises(BagError, match="joint_states"):
        Recording(tmp_path / "bag")
