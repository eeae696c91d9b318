"""Scene files: what they may say, and what is said about those that may not."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from arm_simulation import ARM, with_obstacle

from contact_reach_ros.arm import link_frames
from contact_reach_ros.errors import SceneError, SettingsError
from contact_reach_ros.scenes.generate import make_scene, parse_target
from contact_reach_ros.world.collision import check_hand, nearest
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.rigid import Plane
from contact_reach_ros.world.scene import MismatchSettings
from contact_reach_ros.world.scene_file import TargetSettings, read_scene, scene_names


@pytest.fixture
def file(tmp_path) -> Path:
    return tmp_path / "own.yaml"


def test_scenes_of_the_package_can_be_read():
    assert {"free", "ball"} <= set(scene_names())
    for name in scene_names():
        assert read_scene(name).name == name
    assert read_scene("free").obstacles == ()
    assert read_scene("ball").obstacles == (BallSettings(),)
    assert read_scene("ball").target == TargetSettings(reach=ARM.reach)


@pytest.mark.parametrize("name", ["", "missing/scene", "missing.yaml"])
def test_unknown_scene_lists_the_scenes(name):
    with pytest.raises(SceneError) as raised:
        read_scene(name)
    assert str(raised.value).startswith(f"scene '{name}'")
    assert all(scene in str(raised.value) for scene in scene_names())


TABLE = "environment: {table: {center: [0.5, 0.0, 0.1], size: [0.4, 0.6, 0.3]}}\n"
REFUSED = [
    ("bal: {}", r"'bal'; did you mean 'ball'\?"),
    ("target:", "target = None"),
    ("ball: {raduis: 0.1}", "ball: unknown key 'raduis'"),
    ("ball: {radius: 0.9}", r"ball: radius = 0\.9"),
    ("target: {minimum: [0.3, 0, 0], maximum: [0.2, 1, 1]}", "target: minimum"),
    ("obstacles: [{kind: cube}]", r"obstacles\[0\]: kind = 'cube'"),
    ("obstacles: [{kind: [ball]}]", r"obstacles\[0\]: kind = \['ball'\]; expected one of"),
    ("obstacles: [{kind: ball, size: 1}]", r"obstacles\[0\]: unknown key 'size'"),
    ("environment: {table: {sise: [1, 1, 1]}}", "environment: table: unknown key 'sise'"),
    ("environment: {floor: {normal: [0, 0, 0]}}", "environment: floor: normal"),
    ("environment: {table: {size: [1, 1, 1]}}", "environment: table: center"),
    ("environment: {table: {center: [0, 0, 0], size: [1, 0, 1]}}", "environment: table: size"),
    ("environment: {table: {center: [a, 0, 0], size: [1, 1, 1]}}", "environment: table: center: expected numbers"),
    ("environment: {floor: {point: [true, true, true]}}", "environment: floor: point: expected numbers"),
    ("environment: {floor: {point: ['0.1', '0', '0']}}", "environment: floor: point: expected numbers"),
    ("environment: {floor: 0.1}", r"environment: floor = 0\.1"),
    ("", "is empty; expected a mapping"),
    ("base: missing.yaml", "base = 'missing.yaml': .*expected .*one of authors_ball, .*, ball, ball_mismatch"),
    ("base: 7", "base = 7 .*expected one of authors_ball, .*, ball, ball_mismatch"),
    # What the simulation could not keep up with.
    ("base: wall\nwall: {nodes: [4, 21, 5], node_radius: 0.01}", "840 spheres and nodes, 672 of which can move"),
    ("ball: {mass: 0.001, stiffness: 2500.0}", "ball: .* of 3500 N/m in all .* stable up to 2000 N/m"),
    # What no seed makes possible. The flange starts at (0.528, 0, 0.378); the forearm ends 0.126 m above it.
    ("target: {start: [0, 0, 0, 2.2, 0, 0, 0]}", r"expected lbr_A4 in \[-2\.094, 2\.094\] rad"),
    ("target: {start: [0, 0, 0, 0, 0, 0]}", "expected a list of 7 values"),
    ("box: {fixed: middle, nodes: [2, 2, 4]}", r"expected 3 or more along y"),
    ("mismatch: {inertia_set: other}", "set 'other' is unknown; expected one of nominal, alternative"),
    ("ball: {center: [0.528, 0.0, 0.6]}", r"at the start lbr_link_\d lies \d+\.\d mm deep in the ball"),
    ("ball: {center: [0.0, 0.15, 0.2]}", r"at the start lbr_link_0 lies 60\.0 mm deep in the ball"),
    ("target: {position: [0.5, 0.2, 0.3]}\nball: {center: [0.5, 0.26, 0.3]}", r"target .* lies 40\.0 mm in"),
    ("target: {position: [0.9, 0.3, 0.3]}", r"position is 0\.9506 m from the shoulder"),
    ("target: {position: [0.05, 0.0, 0.2]}", r"there lbr_link_7 lies 120\.0 mm deep in lbr_link_0"),
    (TABLE, r"at the start lbr_link_7 lies 4\d\.\d mm deep in the table; move"),
    (TABLE.replace("0.3]", "0.2]") + "target: {position: [0.5, 0.1, 0.2]}", r"45\.0 mm deep in the table; .* 50\.0 mm"),
]


@pytest.mark.parametrize(("content", "message"), REFUSED)
def test_a_file_is_refused_by_name_with_what_is_wrong(file, content, message):
    file.write_text(content)
    with pytest.raises((SceneError, SettingsError), match=message) as raised:
        make_scene(read_scene(str(file)), ARM, 0)
    assert str(raised.value).startswith(f"{file}: ")


class TestBase:
    def test_sections_are_taken_over_key_by_key(self, file):
        file.write_text("base: ball\ntarget: {min_distance: 0.3}\nball: {mass: 0.2}\nmismatch: {}\n")
        scene, base = read_scene(str(file)), read_scene("ball")
        assert scene.name == "own"
        assert scene.target == dataclasses.replace(base.target, min_distance=0.3)
        assert scene.obstacles == with_obstacle(base, mass=0.2).obstacles
        assert scene.mismatch == MismatchSettings()

    def test_base_of_a_base_is_found_beside_its_file(self, tmp_path):
        (tmp_path / "folder").mkdir()
        (tmp_path / "folder" / "middle.yaml").write_text("base: bottom.yaml\nball: {radius: 0.08}\n")
        (tmp_path / "folder" / "bottom.yaml").write_text("base: ball\nball: {radius: 0.07, mass: 0.3}\n")
        (tmp_path / "top.yaml").write_text("base: folder/middle.yaml\nball: {friction: 0.5}\n")
        assert read_scene(str(tmp_path / "top.yaml")).obstacles == (BallSettings(radius=0.08, mass=0.3, friction=0.5),)

    def test_circle_is_refused_with_the_files(self, tmp_path, file):
        file.write_text("base: other.yaml\n")
        (tmp_path / "other.yaml").write_text("base: ./own.yaml\n")
        with pytest.raises(SceneError, match=r"own\.yaml -> .*other\.yaml -> .*own\.yaml"):
            read_scene(str(file))


class TestEnvironment:
    def test_bodies_have_the_names_of_their_keys_and_change_those_of_the_base(self, file):
        table = "table: {center: [0.5, 0, 0.1], size: [0.4, 0.6, 0.2], angles: [0, 0, 1.0]}"
        file.write_text(f"base: ball\nenvironment: {{wall: {{}}, {table}}}\n")
        floor, wall, table = read_scene(str(file)).environment
        assert floor == dataclasses.replace(wall, name="floor", point=(0.0, 0.0, -0.1))
        assert wall == Plane("wall", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        assert (table.name, table.center, table.size) == ("table", (0.5, 0.0, 0.1), (0.4, 0.6, 0.2))
        np.testing.assert_allclose(table.axes[:, 0], (np.cos(1.0), np.sin(1.0), 0.0), atol=1e-12)
        file.write_text("base: ball\nenvironment: {floor: null}\n")
        assert read_scene(str(file)).environment == ()

    @pytest.mark.parametrize("name", ["free", "wall"])
    def test_scenes_of_the_package_stand_on_a_floor_below_all_their_targets(self, name):
        (floor,) = read_scene(name).environment
        assert isinstance(floor, Plane)
        scene = make_scene(read_scene(name), ARM, 0)
        assert nearest(ARM, scene.start[None], scene.environment)[0].distance > 0.03
        lowest = np.array([*scene.target[:2], read_scene(name).target.minimum[2]])
        check_hand(ARM, Target(lowest, link_frames(ARM, scene.start)[0][-1]), scene.environment)


def test_target_is_three_numbers():
    np.testing.assert_array_equal(parse_target(" 0.5 -0.1  3e-1 "), [0.5, -0.1, 0.3])
    assert parse_target("  ") is None
    for text in ("0.5 0.1", "a b c", "nan 0 0"):
        with pytest.raises(SceneError, match="three finite numbers"):
            parse_target(text)
