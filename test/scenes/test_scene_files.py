"""Scene files: what they may say, and what is said about those that may not."""

from pathlib import Path

import numpy as np
import pytest

from contact_reach_ros.errors import SceneError, SettingsError
from contact_reach_ros.scenes.scene import BallSettings, TargetSettings, parse_target, read_scene, scene_names


@pytest.fixture
def file(tmp_path) -> Path:
    return tmp_path / "own.yaml"


def test_scenes_of_the_package_can_be_read():
    assert {"free", "ball"} <= set(scene_names())
    for name in scene_names():
        assert read_scene(name).name == name
    assert read_scene("free").ball is None
    assert read_scene("ball").ball == BallSettings()
    assert read_scene("ball").target == TargetSettings()


@pytest.mark.parametrize("name", ["bal", "", "ball/", "missing.yaml"])
def test_unknown_scene_lists_the_scenes(name):
    with pytest.raises(SceneError) as raised:
        read_scene(name)
    assert f"scene '{name}' is unknown" in str(raised.value)
    assert all(scene in str(raised.value) for scene in scene_names())


def test_own_file_replaces_what_it_names(file):
    file.write_text("target:\n  min_distance: 0.3\nball:\n  radius: 0.05\n")
    scene = read_scene(str(file))
    assert scene.name == "own"
    assert scene.target == TargetSettings(min_distance=0.3)
    assert scene.ball == BallSettings(radius=0.05)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("bal: {}", "unknown key 'bal'; did you mean 'ball'?"),
        ("1: {}", "unknown key '1'; known keys: ball, target"),
        ("target:", "target = None; expected a mapping"),
        ("ball: [1]", "ball = [1]; expected a mapping"),
        ("target: {start_position: 1}", "target: unknown key 'start_position'"),
        ("ball: {raduis: 0.1}", "ball: unknown key 'raduis'; did you mean 'radius'?"),
        ("ball: {radius: 0.9}", "ball: radius = 0.9: expected a number in [0.01, 0.5] m"),
        ("ball: {stiffness: soft}", "ball: stiffness = 'soft': expected a number"),
        ("target: {minimum: [0, 0]}", "target: minimum = [0, 0]: expected a list of 3 values"),
        ("target: {minimum: [0.3, 0, 0], maximum: [0.2, 1, 1]}", "target: minimum = (0.3, 0.0, 0.0): expected at most"),
        ("ball: {min_overlap: 0.1}", "ball: min_overlap = 0.1: expected at most max_overlap = 0.05 m"),
        ("target: {start: [0, 0, 0, 2.2, 0, 0, 0]}", "expected lbr_A4 in [-2.094, 2.094] rad"),
        ("", "holds NoneType"),
        ("target: {", "not valid YAML"),
    ],
)
def test_file_is_named_when_it_is_refused(file, content, message):
    file.write_text(content)
    with pytest.raises(SettingsError) as raised:
        read_scene(str(file))
    assert str(raised.value).startswith(str(file))
    assert message in str(raised.value)


def test_target_is_three_numbers():
    np.testing.assert_array_equal(parse_target(" 0.5 -0.1  3e-1 "), [0.5, -0.1, 0.3])
    assert parse_target("") is None
    assert parse_target("  ") is None


@pytest.mark.parametrize("text", ["0.5 0.1", "1 2 3 4", "a b c", "0.5, 0.1, 0.2", "nan 0 0", "inf 0 0"])
def test_target_that_is_not_is_refused(text):
    with pytest.raises(SceneError, match="expected three finite numbers 'x y z' in m"):
        parse_target(text)
