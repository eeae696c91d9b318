"""Obstacles survive the way into markers and back, and what is no obstacle is refused by name."""

import dataclasses
import itertools

import numpy as np
import pytest
from arm_simulation import ARM, HOME, numbered
from rclpy.serialization import deserialize_message, serialize_message
from serialized_helpers import garbage
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray, UVCoordinate

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.conversions import to_point
from contact_reach_ros.messages.obstacle_markers import ObstacleMarkerWriter, obstacle_markers
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial, ObstacleMarkerReader
from contact_reach_ros.world.obstacle_kinds import BallSettings, WallSettings
from contact_reach_ros.world.rigid import Block, Plane
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions

MATERIAL = AssumedMaterial(
    sphere_stiffness=100.0,
    sphere_damping=30.0,
    node_stiffness=0.0,
    node_damping=5.0,
    edge_stiffness=WallSettings().edge_stiffness,
)
STAMP_NS = 1_795_233_693_122_143_135


def scene() -> Scene:
    """Two balls and two walls, made of `MATERIAL`."""
    balls = [BallSettings(radius=0.05 * (k + 1)).at(np.array([0.1 * k, 0.2, 0.9])) for k in range(2)]
    obstacles = itertools.chain(*balls, WallSettings().at(np.array([0.5, 0.0, 0.3])))
    return Scene("test", ARM, 0, HOME, np.zeros(3), numbered(obstacles))


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
    positions = displaced()
    spheres = new_reader().read(ObstacleMarkerWriter(scene()).write(positions, STAMP_NS))
    assert as_set(spheres) == as_set(obstacle_spheres(scene(), positions))


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


def test_fast_writing_is_the_same_as_building_the_message():
    writer = ObstacleMarkerWriter(scene())
    for shift in (0.0, 0.1):
        positions = displaced() + shift
        written = writer.write(positions, STAMP_NS)
        expected = serialize_message(obstacle_markers(scene(), positions, STAMP_NS))
        # Not compared as bytes, since what fills the gaps between fields may be anything.
        assert deserialize_message(written, MarkerArray) == deserialize_message(expected, MarkerArray)


def test_no_obstacles_make_an_empty_message():
    empty = Scene("free", ARM, 0, HOME, np.zeros(3))
    data = ObstacleMarkerWriter(empty).write(np.zeros((0, 3)), STAMP_NS)
    assert deserialize_message(data, MarkerArray).markers == []
    assert len(new_reader().read(data)) == 0


def test_movable_and_fixed_nodes_and_edges_are_told_apart():
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    wall = scene().obstacles[2]
    assert len(marker(message, "obstacles").points) == (~wall.fixed).sum()
    assert len(marker(message, "fixed").points) == wall.fixed.sum()
    assert len(marker(message, "edges").points) == 2 * len(wall.edges)
    assert marker(message, "fixed").color != marker(message, "obstacles").color
    assert {one.type for one in message.markers if one.id < 2} == {Marker.SPHERE}


def test_edges_follow_the_nodes_and_are_looked_up_again_when_they_change():
    reader = new_reader()
    first = reader.read(serialize_message(obstacle_markers(scene(), rest_positions(scene()), STAMP_NS)))
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    np.testing.assert_array_equal(reader.read(serialize_message(message)).edges, first.edges)
    # One edge now joins other nodes.
    edges = marker(message, "edges")
    edges.points[0] = marker(message, "obstacles").points[7]
    edges.points[1] = marker(message, "fixed").points[3]
    changed = reader.read(serialize_message(message)).edges
    expected = first.edges.copy()
    expected[0] = (2 + 7, 2 + 44 + 3)
    np.testing.assert_array_equal(changed, expected)


def test_places_where_spheres_were_first_seen_are_their_rest():
    reader = new_reader()
    for positions in (rest_positions(scene()), displaced()):
        message = obstacle_markers(scene(), positions, STAMP_NS)
        message.markers = [one for one in message.markers if one.ns != "rest"]
        spheres = reader.read(serialize_message(message))
    told = new_reader().read(serialize_message(obstacle_markers(scene(), displaced(), STAMP_NS)))
    np.testing.assert_array_equal(spheres.rest, told.rest)


def test_spheres_of_perception_may_be_in_any_namespace():
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    message.markers = [marker(message, "obstacles", 0)]
    message.markers[0].ns = "balls"
    assert len(new_reader().read(serialize_message(message))) == 1


def spoil_frame(message):
    marker(message, "edges").header.frame_id = "world"


def spoil_type(message):
    marker(message, "fixed").type = Marker.CUBE_LIST


def spoil_action(message):
    marker(message, "obstacles").action = Marker.DELETE


def spoil_point(message):
    marker(message, "obstacles").points[5].y = float("nan")


def spoil_edge(message):
    marker(message, "edges").points[9] = to_point((0.0, 0.0, 5.0))


def spoil_edge_count(message):
    marker(message, "edges").points.pop()


def spoil_nodes(message):
    message.markers = [marker(message, "edges")]
    message.markers[0].id = 9


def spoil_rest(message):
    marker(message, "rest").points.pop()


def spoil_size(message):
    marker(message, "fixed").scale.x = 0.0


def spoil_pose(message):
    marker(message, "obstacles").pose.position.x = 0.1


def spoil_twice(message):
    message.markers.append(marker(message, "obstacles"))


def spoil_fixture(message):
    marker(message, "edges").points.clear()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (spoil_frame, "frame_id is 'world'; expected 'lbr_link_0'"),
        (spoil_type, "fixed/2 has type 6 and action 0; expected SPHERE_LIST, to ADD"),
        (spoil_action, "obstacles/2 has type 7 and action 2; expected SPHERE or SPHERE_LIST, to ADD"),
        (spoil_point, r"obstacles/2: point 5 is \[.*nan.*\]; expected finite values"),
        (spoil_edge, r"edges/2: edge 4 ends at \[0.0, 0.0, 5.0\] m, where no node is; expected a point of obstacles/2"),
        (spoil_edge_count, "edges/2 has 273 points; expected an even number"),
        (spoil_nodes, "edges/9: edge .* where no node is"),
        (spoil_rest, "rest/2 has 43 points; expected 44"),
        (spoil_size, "fixed/2: scale.x = 0.0; expected a diameter"),
        (spoil_pose, "obstacles/2 has a pose; expected none"),
        (spoil_twice, "obstacles/2 comes twice"),
        (spoil_fixture, "nothing holds sphere"),
    ],
)
def test_bad_message_is_refused_by_name(spoil, said):
    reader = new_reader()
    reader.read(serialize_message(obstacle_markers(scene(), rest_positions(scene()), STAMP_NS)))
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    spoil(message)
    with pytest.raises(InputError, match=said):
        reader.read(serialize_message(message))


@pytest.mark.parametrize("scale", [(0.1, 0.4, 0.4), (0.1, 0.1, 0.2), (0.1, float("nan"), 0.1)])
@pytest.mark.parametrize(("namespace", "identifier"), [("obstacles", 0), ("obstacles", 2), ("fixed", 2)])
def test_spheres_that_are_not_round_are_refused(namespace, identifier, scale):
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    size = marker(message, namespace, identifier).scale
    size.x, size.y, size.z = scale
    with pytest.raises(InputError, match=rf"{namespace}/{identifier}: scale = .*; expected one diameter in x, y and z"):
        new_reader().read(serialize_message(message))


def test_a_diameter_may_be_given_in_x_alone():
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    expected = new_reader().read(serialize_message(message))
    for one in message.markers:
        one.scale.y = one.scale.z = 0.0
    np.testing.assert_array_equal(new_reader().read(serialize_message(message)).radius, expected.radius)


def unread_fields(size: int, random: np.random.Generator) -> MarkerArray:
    """The obstacles, with what no reader of obstacles looks at, in lists and texts of this size."""
    message = obstacle_markers(scene(), displaced(), STAMP_NS)
    for one in message.markers:
        one.color.r, one.lifetime.sec, one.frame_locked, one.mesh_use_embedded_materials = 0.3, size, True, True
        one.colors = [ColorRGBA(r=0.5)] * size
        one.texture.header.frame_id = one.texture.format = one.texture_resource = "t" * size
        one.texture.data = one.mesh_file.data = random.bytes(size)
        one.uv_coordinates = [UVCoordinate(u=0.1, v=0.2)] * size
        one.text, one.mesh_resource, one.mesh_file.filename = "ä" * size, "m" * size, "f" * size
    return message


class TestSerialized:
    @pytest.mark.parametrize("size", range(9))
    def test_fields_of_any_size_that_are_not_read_change_nothing(self, size):
        expected = new_reader().read(serialize_message(obstacle_markers(scene(), displaced(), STAMP_NS)))
        reader = new_reader()
        spheres = reader.read(serialize_message(unread_fields(size, np.random.default_rng(size))))
        assert all(np.array_equal(getattr(spheres, name), getattr(expected, name)) for name in vars(spheres))
        assert reader.stamp_ns == STAMP_NS

    def test_other_byte_orders_are_refused(self):
        message = serialize_message(obstacle_markers(scene(), displaced(), STAMP_NS))
        with pytest.raises(InputError, match="not in plain CDR, little-endian"):
            new_reader().read(b"\0\0" + message[2:])

    @pytest.mark.parametrize("change", ["scale", "id", "action"])
    def test_changes_are_noticed(self, change):
        reader = new_reader()
        message = obstacle_markers(scene(), displaced(), STAMP_NS)
        for _ in range(3):
            reader.read(serialize_message(message))
        ball = marker(message, "obstacles", 0)
        if change == "scale":
            ball.scale.x = ball.scale.y = ball.scale.z = 0.3
            assert reader.read(serialize_message(message)).radius[0] == 0.15
        elif change == "id":
            ball.id = 7
            assert len(reader.read(serialize_message(message))) == len(displaced())
        else:
            ball.action = Marker.DELETE
            with pytest.raises(InputError, match="action 2"):
                reader.read(serialize_message(message))

    def test_bytes_that_are_no_message_are_refused(self):
        reader = new_reader()
        message = serialize_message(obstacle_markers(scene(), displaced(), STAMP_NS))
        for data in garbage(message):
            with pytest.raises(InputError, match=r"^obstacles: (\d+ bytes that are no MarkerArray; expected|marker)"):
                reader.read(data)
            assert len(reader.read(message)) == len(displaced())


class TestRigidBodies:
    BODIES = (
        Plane("floor", (0.0, 0.0, -0.1)),
        Plane("wall", (1.0, 0.2, 0.0), (-1.0, 0.3, 0.1)),
        Block("table", (0.5, 0.0, 0.1), (0.4, 0.6, 0.2), (0.1, 0.2, 0.3, 0.9273618)),
    )

    def scene(self, *bodies) -> Scene:
        return dataclasses.replace(scene(), environment=bodies or self.BODIES)

    def test_the_planner_reads_what_the_driver_writes(self):
        data = ObstacleMarkerWriter(self.scene()).write(displaced(), STAMP_NS)
        spheres = new_reader().read(data)
        assert as_set(spheres) == as_set(obstacle_spheres(scene(), displaced()))
        for body, read in zip(self.BODIES, spheres.environment, strict=True):
            points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
            assert (type(read), read.name) == (type(body), body.name)
            np.testing.assert_allclose(read.distances(points), body.distances(points), atol=1e-9)

    def test_they_are_kept_while_only_points_change_and_read_again_when_they_move(self):
        reader, writer = new_reader(), ObstacleMarkerWriter(self.scene())
        first = reader.read(writer.write(displaced(), STAMP_NS))
        later = reader.read(writer.write(displaced() + 0.1, STAMP_NS + 1))
        assert later.environment == first.environment
        moved = dataclasses.replace(self.BODIES[2], center=(0.5, 0.3, 0.1))
        other = ObstacleMarkerWriter(self.scene(*self.BODIES[:2], moved))
        for shift in (0.0, 0.1):
            spheres = reader.read(other.write(displaced() + shift, STAMP_NS))
            assert spheres.environment[2].center == moved.center
        back = reader.read(writer.write(displaced(), STAMP_NS))
        assert back.environment == first.environment

    def test_a_scene_without_spheres_has_them_too(self):
        bare = Scene("test", ARM, 0, HOME, np.zeros(3), environment=self.BODIES)
        spheres = new_reader().read(ObstacleMarkerWriter(bare).write(np.zeros((0, 3)), STAMP_NS))
        assert len(spheres) == 0
        assert [body.name for body in spheres.environment] == ["floor", "wall", "table"]

    def test_cubes_of_others_are_blocks_named_by_namespace_and_id(self):
        message = obstacle_markers(self.scene(), displaced(), STAMP_NS)
        marker(message, "block").ns = "furniture"
        marker(message, "furniture").text = ""
        (block,) = (
            body for body in new_reader().read(serialize_message(message)).environment if isinstance(body, Block)
        )
        assert block.name == "furniture/2"

    @pytest.mark.parametrize(
        ("change", "error"),
        [
            (lambda cube: setattr(cube.scale, "y", 0.0), "marker block/2: table: size = .* expected positive lengths"),
            (lambda cube: setattr(cube.pose.orientation, "w", 3.0), "marker block/2: table: orientation = .* unit"),
            (lambda cube: setattr(cube.pose.position, "x", np.nan), "marker block/2: table: center: expected finite"),
            (lambda cube: setattr(cube.header, "frame_id", "map"), "header.frame_id is 'map'"),
            (lambda cube: setattr(cube, "action", Marker.DELETE), "marker block/2 has action 2; expected CUBE, to ADD"),
        ],
    )
    def test_one_that_cannot_be_is_refused_by_name(self, change, error):
        message = obstacle_markers(self.scene(), displaced(), STAMP_NS)
        change(marker(message, "block"))
        with pytest.raises(InputError, match=error):
            new_reader().read(serialize_message(message))
