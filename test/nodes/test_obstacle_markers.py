"""Obstacles survive the way into markers and back, and what is no obstacle is refused by name."""

import dataclasses
import itertools

import numpy as np
import pytest
from arm_simulation import ARM, HOME
from geometry_msgs.msg import Point, Quaternion, Vector3
from hostile import garbage
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray, UVCoordinate

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.conversions import to_marker, to_point
from contact_reach_ros.messages.obstacle_markers import ObstacleMarkerWriter, obstacle_markers
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.planning.settings import PlannerNodeSettings
from contact_reach_ros.world.obstacle import BallSettings, WallSettings
from contact_reach_ros.world.rigid import Block, Plane, point_distances
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

MATERIAL = PlannerNodeSettings(sphere_stiffness=BallSettings().stiffness, edge_stiffness=WallSettings().edge_stiffness)
STAMP_NS = 1_795_233_693_122_143_135
TABLE = Block("table", (0.5, 0.0, 0.1), (0.4, 0.6, 0.2), (0.1, 0.2, 0.3, 0.9273618))


def scene() -> Scene:
    """Two balls and two walls."""
    balls = [BallSettings(radius=0.05 * (k + 1)).at(np.array([0.1 * k, 0.2, 0.9])) for k in range(2)]
    obstacles = itertools.chain(*balls, WallSettings().at(np.array([0.5, 0.0, 0.3])))
    return Scene("test", ARM, 0, HOME, np.zeros(3), tuple(obstacles))


def new_reader() -> ObstacleMarkerReader:
    return ObstacleMarkerReader(ARM.base_frame, MATERIAL)


def displaced() -> np.ndarray:
    rests = rest_positions(scene())
    fixed = np.concatenate([obstacle.fixed for obstacle in scene().obstacles])
    return rests + np.where(fixed[:, None], 0.0, np.random.default_rng(0).normal(0.0, 0.02, rests.shape))


def marker(message: MarkerArray, namespace: str, identifier: int = 2) -> Marker:
    (found,) = (one for one in message.markers if one.ns == namespace and one.id == identifier)
    return found


def as_set(spheres) -> set:
    """What a planner makes of spheres, whatever their order."""
    columns = (spheres.radius, spheres.stiffness, spheres.damping)
    nodes = [tuple(row) for row in np.round(np.column_stack([spheres.center, spheres.rest, *columns]), 9).tolist()]
    edges = {
        (frozenset((nodes[start], nodes[end])), stiffness)
        for (start, end), stiffness in zip(spheres.edges.tolist(), spheres.edge_stiffness, strict=True)
    }
    assert len(edges) == len(spheres.edges)
    return set(nodes) | edges


def test_the_planner_reads_what_the_driver_writes():
    writer, reader = ObstacleMarkerWriter(scene()), new_reader()
    for positions, stamp_ns in ((displaced(), STAMP_NS), (rest_positions(scene()), STAMP_NS + 1)):
        spheres = reader.read(writer.write(positions, stamp_ns))
        assert as_set(spheres) == as_set(obstacle_spheres(scene(), positions))
        assert reader.stamp_ns == stamp_ns


def test_they_were_seen_at_the_oldest_stamp_that_is_set():
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    marker(message, "edges").header.stamp.sec -= 3
    marker(message, "rest").header.stamp.sec = marker(message, "rest").header.stamp.nanosec = 0
    reader = new_reader()
    for later_s in (0, 1):
        for one in message.markers:
            one.header.stamp.sec += later_s if one.header.stamp.sec else 0
        reader.read(serialize_message(message))
        assert reader.stamp_ns == STAMP_NS + (later_s - 3) * 1_000_000_000
    for one in message.markers:
        one.header.stamp.sec = one.header.stamp.nanosec = 0
    for unstamped in (message, MarkerArray()):
        reader.read(serialize_message(unstamped))
        assert reader.stamp_ns is None


def test_places_where_spheres_were_first_seen_are_their_rest():
    reader = new_reader()
    for positions in (rest_positions(scene()), displaced()):
        message = obstacle_markers(scene(), positions, STAMP_NS)
        message.markers = [one for one in message.markers if one.ns != "rest"]
        spheres = reader.read(serialize_message(message))
    told = new_reader().read(serialize_message(obstacle_markers(scene(), displaced(), STAMP_NS)))
    np.testing.assert_array_equal(spheres.rest, told.rest)


def test_the_rest_of_a_body_that_is_gone_or_has_other_nodes_is_forgotten():
    reader, seen = new_reader(), []
    for count, x in ((2, 0.5), (3, 0.6), (0, 0.0), (3, 0.7)):
        points, held = [Point(x=x, y=0.1 * number) for number in range(count)], Point(x=x, y=-0.1)
        lines = [end for point in points for end in (point, held)]
        size = Vector3(x=0.02, y=0.02, z=0.02)
        markers = [
            Marker(ns="obstacles", type=Marker.SPHERE_LIST, scale=size, points=points),
            Marker(ns="fixed", type=Marker.SPHERE_LIST, scale=size, points=[held]),
            Marker(ns="edges", type=Marker.LINE_LIST, points=lines),
        ]
        for one in markers:
            one.header.frame_id = ARM.base_frame
        spheres = reader.read(serialize_message(MarkerArray(markers=markers if count else [])))
        seen.append([round(float(each), 3) for each in spheres.rest[:count, 0]])
    assert seen == [[0.5] * 2, [0.6] * 3, [], [0.7] * 3]


def change(path, value, namespace="obstacles", identifier=2):
    """Changes one field of a marker, such as 'pose.position.x'."""

    def apply(message):
        *parents, name = path.split(".")
        target = marker(message, namespace, identifier)
        for parent in parents:
            target = getattr(target, parent)
        setattr(target, name, value)

    return apply


SPOILED = [
    (change("header.frame_id", "world", "edges"), "frame_id is 'world'; expected 'lbr_link_0'"),
    (change("type", Marker.CUBE_LIST, "fixed"), "fixed/2 has type 6"),
    (change("action", Marker.DELETE), "obstacles/2 has type 7 and action 2"),
    (lambda message: marker(message, "obstacles").points.append(to_point((0.0, np.nan, 0.0))), "obstacles/2 .*nan"),
    (lambda message: marker(message, "edges").points.pop(), "edges/2 has"),
    (lambda message: marker(message, "edges").points.extend([to_point((0, 0, 5))] * 2), "edges/2: edge .* no node"),
    (lambda message: marker(message, "edges").points.clear(), "nothing holds sphere"),
    (change("text", "stiffness 1 40 -3", "edges"), "edges/2 has text .* expected 138 positive numbers"),
    (lambda message: message.markers.remove(marker(message, "obstacles")), "rest/2 has 44 points; expected 0"),
    (lambda message: message.markers.append(marker(message, "obstacles")), "obstacles/2 comes twice"),
    (
        lambda message: message.markers.remove(marker(message, "edges")),
        "obstacles/2 is .* a SPHERE for each ball",
    ),
    (lambda message: message.markers.remove(marker(message, "obstacles", 0)), "rest/0 has 1 points; expected 0"),
    (change("header.frame_id", ""), "frame_id is ''; expected 'lbr_link_0'"),
    (change("type", Marker.CYLINDER, "obstacles", 0), "obstacles/0 has type 3 and action 0; expected SPHERE"),
    (change("action", Marker.DELETEALL, "obstacles", 0), "obstacles/0 has type 2 and action 3; expected .* to ADD"),
    (change("action", Marker.DELETE, "block", 0), "block/0 has action 2; expected CUBE, to ADD"),
    (change("pose.position.z", np.inf, "obstacles", 0), "obstacles/0 has point 0 at .*inf"),
    (change("scale", Vector3(), "obstacles", 0), "obstacles/0 has scale"),
    (change("scale.x", -0.4, "obstacles", 0), "obstacles/0 has scale = .* expected a diameter"),
    (change("pose.position.x", 0.1), "obstacles/2 has a pose"),
    (change("scale.y", 0.0, "block", 0), "block/0 .* size"),
    (change("pose.orientation.w", 3.0, "block", 0), "block/0 .* orientation"),
    (change("pose.orientation", Quaternion(w=0.0), "block", 0), "block/0 .* expected a unit quaternion"),
]


@pytest.mark.parametrize(("spoil", "said"), SPOILED, ids=[said for _, said in SPOILED])
def test_a_bad_message_is_refused_by_marker_and_field(spoil, said):
    message = obstacle_markers(dataclasses.replace(scene(), environment=(TABLE,)), displaced(), STAMP_NS)
    spoil(message)
    with pytest.raises(InputError, match=said):
        new_reader().read(serialize_message(message))


def test_markers_of_perception_may_be_in_any_namespace_and_are_as_large_as_their_longest_axis():
    message = obstacle_markers(dataclasses.replace(scene(), environment=(TABLE,)), displaced(), STAMP_NS)
    ball, table = marker(message, "obstacles", 0), marker(message, "block", 0)
    ball.ns, ball.scale = "balls", Vector3(x=0.1, y=0.3)
    table.ns, table.text = "furniture", ""
    spheres = new_reader().read(serialize_message(MarkerArray(markers=[ball, table])))
    assert spheres.radius.tolist() == [0.15]
    assert [body.name for body in spheres.environment] == ["furniture/0"]


def test_obstacles_of_two_namespaces_may_have_one_id():
    message = MarkerArray()
    for namespace, x in (("hand", 0.2), ("head", 0.6)):
        one = Marker(ns=namespace, id=0, type=Marker.SPHERE, scale=Vector3(x=0.1, y=0.1, z=0.1))
        one.header.frame_id, one.pose.position.x, one.pose.orientation.w = ARM.base_frame, x, 1.0
        message.markers.append(one)
    reader = new_reader()
    np.testing.assert_array_equal(reader.read(serialize_message(message)).center[:, 0], [0.2, 0.6])
    message.markers.pop(0)
    # Each has the place where it was seen first.
    message.markers[0].pose.position.x = 0.7
    spheres = reader.read(serialize_message(message))
    assert (spheres.center[0, 0], spheres.rest[0, 0]) == (0.7, 0.6)


def test_balls_may_have_any_name_number_and_size():
    names = [("Hände", 0), ("hand", -1), ("plane", 7), ("block", 7), *(("cloud", number) for number in range(1000))]
    message = MarkerArray()
    for place, (namespace, number) in enumerate(names):
        one = to_marker(namespace, number, Marker.SPHERE, 3 * [50.0 if place == 0 else 0.1], (1, 1, 1, 1))
        one.header.frame_id, one.pose.position.x, one.text = ARM.base_frame, 0.001 * place, "material: stiffness=100"
        message.markers.append(one)
    nothing = to_marker("nothing", 0, Marker.SPHERE_LIST, 3 * [0.1], (1, 1, 1, 1))
    nothing.header.frame_id = ARM.base_frame
    message.markers.append(nothing)
    spheres = new_reader().read(serialize_message(message))
    assert sorted(spheres.center[:, 0]) == [0.001 * place for place in range(len(names))]
    assert spheres.radius.max() == 25.0 and set(spheres.stiffness) == {MATERIAL.sphere_stiffness}
    assert not spheres.environment


@pytest.mark.parametrize("size", [1, 2, 3, 8])
def test_fields_of_any_size_that_are_not_read_change_nothing(size):
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    expected = new_reader().read(serialize_message(message))
    for one in message.markers:
        one.color.r, one.lifetime.sec, one.frame_locked, one.mesh_use_embedded_materials = 0.3, size, True, True
        one.colors = [ColorRGBA(r=0.5)] * size
        one.texture.header.frame_id = one.texture.format = one.texture_resource = "t" * size
        one.texture.data = one.mesh_file.data = bytes(range(size))
        one.uv_coordinates = [UVCoordinate(u=0.1, v=0.2)] * size
        one.text, one.mesh_resource, one.mesh_file.filename = "ä" * size, "m" * size, "f" * size
    spheres = new_reader().read(serialize_message(message))
    assert all(np.array_equal(getattr(spheres, name), getattr(expected, name)) for name in vars(spheres))


def test_bytes_that_are_no_message_are_refused():
    reader = new_reader()
    message = serialize_message(obstacle_markers(scene(), displaced(), STAMP_NS))
    for data in (*garbage(message), b"\0\0" + message[2:]):
        with pytest.raises(InputError, match=r"^obstacles: (\d+ bytes that are no MarkerArray; expected|marker)"):
            reader.read(data)
    assert len(reader.read(message)) == len(displaced())


def test_rigid_bodies_survive_the_way_into_markers_and_back():
    bodies = (Plane("floor", (0.0, 0.0, -0.1)), Plane("wall", (1.0, 0.2, 0.0), (-1.0, 0.3, 0.1)), TABLE)
    data = ObstacleMarkerWriter(dataclasses.replace(scene(), environment=bodies)).write(displaced(), STAMP_NS)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    found = new_reader().read(data).environment
    assert [(type(body), body.name) for body in found] == [(type(body), body.name) for body in bodies]
    np.testing.assert_allclose(point_distances(found, points), point_distances(bodies, points), atol=1e-9)
