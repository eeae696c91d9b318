"""The pages in msg_docs say what the code does: each parameter with its default, each topic, each service."""

import pytest
from setting_rows import setting_row

from contact_reach_ros.nodes import bringup, topics
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.parameter_files import full_name
from contact_reach_ros.resources import share_directory
from contact_reach_ros.viewer.settings import ViewerSettings

SECTIONS = {
    "driver": DriverNode.SECTIONS,
    "controller": ControllerNode.SECTIONS,
    "observer": ObserverNode.SECTIONS,
    "planner": PlannerNode.SECTIONS,
    "recorder": RecorderNode.SECTIONS,
    "viewer": {"": ViewerSettings},
    "bringup": bringup.SECTIONS,
}


@pytest.mark.parametrize("node", SECTIONS)
def test_every_parameter_is_listed_with_its_default_and_range(node):
    page = (share_directory() / "msg_docs" / f"{node}.md").read_text()
    for prefix, settings in SECTIONS[node].items():
        for entry in settings.declared():
            row = setting_row(full_name(prefix, entry.name), entry)
            assert row in page, f"msg_docs/{node}.md lacks the row {row}"


def test_every_topic_is_described_on_some_page():
    pages = "".join(file.read_text() for file in (share_directory() / "msg_docs").glob("*.md"))
    for topic in topics.ALL:
        assert f"| `{topic.name}` | " in pages, f"no page describes {topic.name}"
