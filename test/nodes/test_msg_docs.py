"""The pages in msg_docs say what the code does: each parameter with its default, each topic, each service."""

import pytest
from setting_rows import setting_row

from contact_reach_ros.arms import load_arm
from contact_reach_ros.messages import topics
from contact_reach_ros.presets import SECTIONS
from contact_reach_ros.resources import share_directory
from contact_reach_ros.settings import ROBOT, full_name


@pytest.mark.parametrize("node", SECTIONS)
def test_every_parameter_is_listed_with_its_default_and_range(node):
    page = (share_directory() / "msg_docs" / f"{node}.md").read_text()
    for prefix, settings in SECTIONS[node].items():
        for entry in settings.declared():
            row = setting_row(full_name(prefix, entry.name), entry.for_arm(load_arm()))
            assert row in page, f"msg_docs/{node}.md lacks the row {row}"
    assert node == "bringup" or f"`{ROBOT.name}` (default {ROBOT.default})" in page


def test_every_topic_is_described_on_some_page():
    pages = "".join(file.read_text() for file in (share_directory() / "msg_docs").glob("*.md"))
    for topic in topics.ALL:
        assert f"| `{topic.name}` | " in pages, f"no page describes {topic.name}"
