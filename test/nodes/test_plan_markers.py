"""A plan's picture: paths, and the contact forces where they are expected."""

import numpy as np
from arm_simulation import ARM, HOME
from plans import make_plan
from visualization_msgs.msg import Marker

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.messages.plan_messages import to_markers
from contact_reach_ros.messages.plan_reader import read_plan
from contact_reach_ros.messages.values import vector
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.world.collision import capsule_segments


def bent_plan(forces: dict[tuple[int, int], float] | None = None) -> Plan:
    """A plan of three knots; `forces` are by knot and capsule."""
    q = HOME + 0.05 * np.arange(4)[:, None] * np.arange(1, 8)
    predicted_forces = np.zeros((3, 6))
    for place, force in (forces or {}).items():
        predicted_forces[place] = force
    return make_plan(
        np.zeros((3, 3)),
        np.tile(np.eye(3), (3, 1, 1)),
        q[1:],
        effect_ns=5_000_000_007,
        predicted_q=q,
        predicted_positions=np.array([RobotModel(ARM).tip_pose(angles)[0] for angles in q]),
        predicted_contact_forces=predicted_forces,
    )


def by_name(message) -> dict[tuple[str, int], Marker]:
    shown = [marker for marker in message.markers if marker.action == Marker.ADD]
    found = {(marker.ns, marker.id): marker for marker in shown}
    assert len(found) == len(shown)
    return found


def points(marker: Marker) -> np.ndarray:
    return np.array([vector(point) for point in marker.points])


def test_paths_run_along_flange_and_elbow():
    plan = bent_plan()
    markers = by_name(to_markers(plan, ARM))
    np.testing.assert_allclose(points(markers["flange", 0]), plan.predicted_positions, rtol=0, atol=1e-12)
    elbows = [link_frames(ARM, q)[1][3] for q in plan.predicted_q]
    np.testing.assert_allclose(points(markers["elbow", 0]), elbows, rtol=0, atol=1e-12)
    assert {markers[name].type for name in (("flange", 0), ("elbow", 0))} == {Marker.LINE_STRIP}
    for marker in markers.values():
        assert marker.header.frame_id == ARM.base_frame
        assert (marker.header.stamp.sec, marker.header.stamp.nanosec) == (5, 7)


def test_a_force_is_told_where_the_link_is_when_it_is_largest():
    plan = bent_plan({(0, 2): 1.0, (1, 2): 7.26, (2, 2): 3.0})
    markers = by_name(to_markers(plan, ARM))
    texts = {name: marker for name, marker in markers.items() if name[0] == "contact"}
    (((_, link), text),) = texts.items()
    assert link == ARM.capsules[2].link
    assert text.text == "7.3 N" and text.type == Marker.TEXT_VIEW_FACING
    starts, ends = capsule_segments(ARM, plan.predicted_q[2])
    np.testing.assert_allclose(vector(text.pose.position), (starts[2] + ends[2]) / 2, rtol=0, atol=1e-12)


def test_each_message_replaces_what_was_shown_before():
    first = to_markers(bent_plan({(0, 1): 2.0}), ARM).markers
    assert [marker.action for marker in first] == [Marker.DELETEALL, *[Marker.ADD] * (len(first) - 1)]
    (marker,) = to_markers(None, ARM).markers
    assert marker.action == Marker.DELETEALL
    assert read_plan(to_markers(None, ARM)) is None and read_plan(to_markers(bent_plan(), ARM)) is not None
