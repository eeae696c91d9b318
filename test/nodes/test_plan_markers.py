"""A plan's picture: paths, and the contact forces where they are expected."""

import numpy as np
from arm_simulation import ARM, HOME
from plans import make_plan
from visualization_msgs.msg import Marker

from contact_reach_ros.arm import link_frames
from contact_reach_ros.messages.plan_reader import read_plan
from contact_reach_ros.messages.values import vector
from contact_reach_ros.nodes.planner_output import to_markers
from contact_reach_ros.world.collision import capsule_segments

Q = HOME + 0.05 * np.arange(4)[:, None] * np.arange(1, 8)
TIPS = np.array([link_frames(ARM, q)[1][-1] for q in Q])
FORCES = np.zeros((3, 6))
FORCES[:, 2] = 1.0, 7.26, 3.0
PLAN = make_plan(
    np.zeros((3, 3)),
    np.tile(np.eye(3), (3, 1, 1)),
    Q[1:],
    effect_ns=5_000_000_007,
    predicted_q=Q,
    predicted_positions=TIPS,
    predicted_contact_forces=FORCES,
)


def test_paths_run_along_tip_and_elbow_and_a_force_is_told_where_the_link_is_when_it_is_largest():
    first, *shown = to_markers(PLAN, ARM).markers
    # Each message replaces what was shown before.
    assert first.action == Marker.DELETEALL and {marker.action for marker in shown} == {Marker.ADD}
    markers = {(marker.ns, marker.id): marker for marker in shown}
    for name, path in (("flange", TIPS), ("elbow", [link_frames(ARM, q)[1][3] for q in Q])):
        points = [vector(point) for point in markers[name, 0].points]
        np.testing.assert_allclose(points, path, rtol=0, atol=1e-12)
        assert markers[name, 0].type == Marker.LINE_STRIP
    for marker in shown:
        stamp = marker.header.stamp
        assert (marker.header.frame_id, stamp.sec, stamp.nanosec) == (ARM.base_frame, 5, 7)
    ((link, text),) = [(key[1], marker) for key, marker in markers.items() if key[0] == "contact"]
    assert (link, text.text, text.type) == (ARM.capsules[2].link, "7.3 N", Marker.TEXT_VIEW_FACING)
    starts, ends = capsule_segments(ARM, Q[2])
    np.testing.assert_allclose(vector(text.pose.position), (starts[2] + ends[2]) / 2, rtol=0, atol=1e-12)


def test_no_plan_clears_the_picture():
    (marker,) = to_markers(None, ARM).markers
    assert marker.action == Marker.DELETEALL
    assert read_plan(to_markers(None, ARM)) is None and read_plan(to_markers(PLAN, ARM)) is not None
