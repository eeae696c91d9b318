"""docs/scenes.md lists every key of a scene file, and its examples can be read."""

import re
from pathlib import Path

import pytest
from arm_simulation import ARM
from setting_rows import setting_row

from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene_file import BASE, BLOCK_KEYS, PLANE_KEYS, SECTIONS, read_scene, scene_names

PAGE = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text()


@pytest.mark.parametrize("section", SECTIONS)
def test_every_key_is_listed_with_its_default_and_range(section):
    for entry in SECTIONS[section].declared():
        row = setting_row(f"{section}.{entry.name}", entry)
        assert row in PAGE, f"docs/scenes.md lacks the row {row}"


def test_every_key_of_a_rigid_body_is_told():
    told = PAGE.split("A plane has a ")[1].split("\n\n")[0]
    assert re.findall(r"`(\w+)`", told) == [*PLANE_KEYS, *BLOCK_KEYS]


def test_no_other_key_is_listed():
    known = {f"{section}.{entry.name}" for section, cls in SECTIONS.items() for entry in cls.declared()}
    assert set(re.findall(r"^\| `(\w+\.\w+)` \|", PAGE, re.MULTILINE)) == known
    assert f"`{BASE}`" in PAGE


def test_every_scene_of_the_package_is_described():
    for name in scene_names():
        assert f"| `{name}` |" in PAGE


def test_examples_can_be_read_and_made(tmp_path):
    examples = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    assert len(examples) >= 2
    for number, content in enumerate(examples):
        file = tmp_path / f"example{number}.yaml"
        file.write_text(content)
        make_scene(read_scene(str(file)), ARM, 0)
