"""A plan's picture: paths, the arm at its end, and the contact forces where they are expected."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from plans import make_plan
from visualization_msgs.msg import Marker

from contact_reach_ros.arm.kinematics import link_frames, rotation_from_quaternion
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.messages.plan_messages import PlanMarkers
from contact_reach_ros.messages.plan_reader import read_plan
from contact_reach_ros.messages.values import quaternion, vector
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.world.collision import capsule_segments

PERMITTED = 10.0


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
    markers = by_name(PlanMarkers(ARM, PERMITTED).show(plan))
    np.testing.assert_allclose(points(markers["flange", 0]), plan.predicted_positions, rtol=0, atol=1e-12)
    elbows = [link_frames(ARM, q)[1][3] for q in plan.predicted_q]
    np.testing.assert_allclose(points(markers["elbow", 0]), elbows, rtol=0, atol=1e-12)
    assert {markers[name].type for name in (("flange", 0), ("elbow", 0))} == {Marker.LINE_STRIP}
    for marker in markers.values():
        assert marker.header.frame_id == ARM.base_frame
        assert (marker.header.stamp.sec, marker.header.stamp.nanosec) == (5, 7)


def test_the_arm_stands_where_the_plan_ends():
    plan = bent_plan()
    markers = by_name(PlanMarkers(ARM, PERMITTED).show(plan))
    starts, ends = capsule_segments(ARM, plan.predicted_q[-1])
    for index, capsule in enumerate(ARM.capsules):
        marker = markers["arm", index]
        x, y, z, w = quaternion(marker.pose.orientation)
        half = 0.5 * marker.scale.z * rotation_from_quaternion((w, x, y, z))[:, 2]
        middle = vector(marker.pose.position)
        np.testing.assert_allclose(middle - half, starts[index], rtol=0, atol=1e-9)
        np.testing.assert_allclose(middle + half, ends[index], rtol=0, atol=1e-9)
        assert marker.scale.x == marker.scale.y == pytest.approx(2 * capsule.radius)


def test_a_force_is_told_where_the_link_is_when_it_is_largest():
    plan = bent_plan({(0, 2): 1.0, (1, 2): 7.26, (2, 2): 3.0})
    markers = by_name(PlanMarkers(ARM, PERMITTED).show(plan))
    texts = {name: marker for name, marker in markers.items() if name[0] == "contact"}
    (((_, link), text),) = texts.items()
    assert link == ARM.capsules[2].link
    assert text.text == "7.3 N" and text.type == Marker.TEXT_VIEW_FACING
    starts, ends = capsule_segments(ARM, plan.predicted_q[2])
    np.testing.assert_allclose(vector(text.pose.position), (starts[2] + ends[2]) / 2, rtol=0, atol=1e-12)
    # The link is redder than those without contact.
    assert markers["arm", 2].color.r > markers["arm", 0].color.r


def test_each_message_replaces_what_was_shown_before():
    picture = PlanMarkers(ARM, PERMITTED)
    first = picture.show(bent_plan({(0, 1): 2.0})).markers
    assert [marker.action for marker in first] == [Marker.DELETEALL, *[Marker.ADD] * (len(first) - 1)]
    (marker,) = picture.clear().markers
    assert marker.action == Marker.DELETEALL
    assert read_plan(picture.clear()) is None and read_plan(picture.show(bent_plan())) is not None
