"""`contact-reach bag info`."""

import json
from pathlib import Path

import pytest
from conftest import SampleBag
from contact_reach_command import contact_reach
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from contact_reach_ros.bags.command import bag_info
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter

MS = 1_000_000


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """1 kHz with a gap of 0.5 s, one message that is late, and a topic of two messages."""
    stream = RecordedTopic("/stream", "std_msgs/msg/String", latched=True)
    rare = RecordedTopic("/rare", "std_msgs/msg/String")
    lost = {"messages_lost": "3", "messages_lost/stream": "3", "scene": "ball"}
    with BagWriter(tmp_path / "bag", [stream, rare], custom_data=lost) as writer:
        data = serialize_message(String(data="x"))
        times = [*range(0, 500), *range(1000, 1500)]
        times[200], times[201] = times[201], times[200]
        for time in times:
            writer.write("/stream", data, time * MS)
        writer.write("/rare", data, 100 * MS)
        writer.write("/rare", data, 300 * MS)
    return tmp_path / "bag"


def test_info_has_rates_gaps_and_lost_messages(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert contact_reach("bag", "info", bag, "--json", bag / "info.json") == 0
    assert "1002 messages" in capsys.readouterr().out
    content = json.loads((bag / "info.json").read_text())
    assert content["custom_data"]["scene"] == "ball"
    rare, stream = content["topics"]
    assert (stream["name"], stream["message_count"], stream["lost"]) == ("/stream", 1000, 3)
    assert stream["longest_gap_s"] == pytest.approx(0.501)
    assert stream["rate_hz"] == pytest.approx(999 / 1.499)
    assert (stream["latched"], rare["latched"], rare["lost"]) == (True, False, 0)
    assert rare["rate_hz"] == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("content", "expected"),
    [(None, "it.mcap' does not exist"), ("", "it.mcap: is empty"), ("text", "it.mcap: is no mcap file")],
)
def test_no_bag_at_all_is_one_line(
    tmp_path: Path, content: str | None, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "it.mcap"
    if content is not None:
        path.write_text(content)
    assert contact_reach("bag", "info", path) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line


def test_bag_of_a_killed_recorder_is_shown_with_a_note(sample: SampleBag, capsys: pytest.CaptureFixture[str]) -> None:
    sample.file.write_bytes(sample.file.read_bytes()[:-50])
    bag_info(sample.directory, None)
    shown = capsys.readouterr().out
    assert "/goal_pose" in shown and "is cut or damaged" in shown
