"""Arms that were read before come out of the user's cache, as long as nothing that was read has changed."""

from pathlib import Path

import pytest
import trimesh
from test_descriptions import BALL, MASSES, fixed, link, six_joints

from contact_reach_ros.arm.table import table_of
from contact_reach_ros.arm.urdf_reader import Reading, read_arm_file


def exported(file: Path, length: float) -> None:
    trimesh.creation.box((0.1, 0.1, length)).export(file)


@pytest.fixture
def robot(tmp_path, monkeypatch):
    """A robot whose third link is a mesh, and a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    exported(tmp_path / "part.stl", 0.3)
    mesh = '<collision><geometry><mesh filename="part.stl"/></geometry></collision>'
    (tmp_path / "arm.urdf").write_text(six_joints(l3=link("l3", MASSES[2], mesh)))
    return tmp_path / "arm.urdf"


def kept(robot: Path) -> list[Path]:
    return sorted((robot.parent / "cache").rglob("*.pickle"))


def said(reading: Reading) -> tuple:
    fits = {name: (*fit.start, *fit.end, fit.radius, fit.volume_ratio) for name, fit in reading.fits.items()}
    return table_of(reading.arm), reading.arm.digest, fits, reading.assumed, reading.doubts


def test_a_reading_is_kept_whole_and_one_that_is_damaged_or_of_another_is_made_anew(robot):
    first = read_arm_file(robot)
    (entry,) = kept(robot)
    content, written_ns = entry.read_bytes(), entry.stat().st_mtime_ns
    assert said(read_arm_file(robot)) == said(first) and entry.stat().st_mtime_ns == written_ns
    robot.with_suffix(".yaml").write_text("reach: 0.7\n")
    read_arm_file(robot)
    (other,) = {*kept(robot)} - {entry}
    robot.with_suffix(".yaml").unlink()
    flipped = bytes([*content[:-50], content[-50] ^ 1, *content[-49:]])
    for damaged in (b"", b"damaged", content[:-20], flipped, other.read_bytes()):
        entry.write_bytes(damaged)
        assert said(read_arm_file(robot)) == said(first)
        assert entry.read_bytes() != damaged


def test_whatever_is_read_makes_another_arm_when_it_changes(robot):
    digests = [read_arm_file(robot).arm.digest]
    exported(robot.with_name("part.stl"), 0.4)
    digests.append(read_arm_file(robot).arm.digest)
    robot.with_suffix(".yaml").write_text("reach: 0.7\n")
    digests.append(read_arm_file(robot).arm.digest)
    robot.write_text(robot.read_text().replace(BALL, BALL.replace("0.05", "0.06"), 1))
    digests.append(read_arm_file(robot).arm.digest)
    assert len(set(digests)) == 4


def test_what_a_xacro_file_includes_counts(robot):
    pytest.importorskip("xacro", reason="pip install xacro")
    included = robot.with_name("end.xacro")
    calls = f'<xacro:include filename="{included}"/>'
    file = robot.with_name("six.xacro")
    file.write_text(six_joints(calls).replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'))
    tips = []
    for tip in ("probe", "pen"):
        included.write_text(f"<robot>{fixed('l6', tip)}</robot>")
        tips.append(read_arm_file(file).arm.tip_frame)
    assert tips == ["probe", "pen"]


def test_without_a_cache_an_arm_is_read_all_the_same(robot, monkeypatch):
    robot.with_name("file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(robot.with_name("file")))
    assert read_arm_file(robot).arm.n == 6
