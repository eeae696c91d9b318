"""Re-execution of the bag that comes with the package: identical as it is, exact about what differs when it is not."""

import copy
from pathlib import Path

import numpy as np
import pytest

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.intake import Taken
from contact_reach_ros.reexecution.inputs import COMMANDS, RecordedInputs
from contact_reach_ros.reexecution.loops import reexecute
from contact_reach_ros.resources import share_directory
from contact_reach_ros.viewer.recorded import Recording

SAMPLE = share_directory() / "bags" / "sample"


@pytest.fixture(scope="module")
def sample() -> RecordedInputs:
    return RecordedInputs(BagReader(SAMPLE))


def changed(sample: RecordedInputs, **attributes: object) -> RecordedInputs:
    """The sample with other attributes."""
    made = copy.copy(sample)
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def test_torques_and_residuals_are_identical(sample: RecordedInputs) -> None:
    for found in (reexecute("controller", sample), reexecute("observer", sample)):
        assert found.compared > 2500
        assert found.largest_difference <= 1e-9
        assert found.first_difference is None
        assert found.notes == ()


def test_the_first_difference_is_named(tmp_path: Path) -> None:
    reader = BagReader(SAMPLE)
    with BagWriter(tmp_path / "bag", [RecordedTopic(name, topic.type) for name, topic in reader.topics.items()]) as bag:
        for raw in reader.raw_messages():
            data = raw.data
            if raw.topic == f"/{COMMANDS}" and raw.sequence >= 2000:
                torques = np.frombuffer(data, "<f8", 7, len(data) - 56) + 1e-6 * (np.arange(7) == 2)
                data = data[:-56] + torques.tobytes()
            bag.write(raw.topic, data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
    first = reexecute("controller", RecordedInputs(BagReader(tmp_path / "bag"))).first_difference
    assert first is not None
    assert first.tick == 2000
    assert first.field == "effort_controller/commands of lbr_A3"
    assert float(first.recorded) - float(first.reexecuted) == pytest.approx(1e-6, rel=1e-3)


def test_after_lost_messages_it_finds_into_step_again(tmp_path: Path) -> None:
    reader, states = BagReader(SAMPLE), 0
    with BagWriter(tmp_path / "bag", [RecordedTopic(name, topic.type) for name, topic in reader.topics.items()]) as bag:
        for raw in reader.raw_messages():
            states += raw.topic == "/joint_states"
            if raw.topic != "/joint_states" or not 1500 <= states < 1550:
                bag.write(raw.topic, raw.data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
    recorded = RecordedInputs(BagReader(tmp_path / "bag"))
    for found in (reexecute("controller", recorded), reexecute("observer", recorded)):
        assert found.first_difference is None
        # The controller's laws reach full authority within 500 states again.
        assert found.compared > 2000
        assert any(note.startswith("50 messages that the") for note in found.notes)


@pytest.mark.parametrize("topic", ["/reference/pose", "/reference/posture"])
def test_after_a_lost_reference_it_waits_for_the_next_plan(tmp_path: Path, topic: str) -> None:
    """The lost plan takes effect later than the message would have come."""
    reader, references = BagReader(SAMPLE), 0
    with BagWriter(tmp_path / "bag", [RecordedTopic(name, topic.type) for name, topic in reader.topics.items()]) as bag:
        for raw in reader.raw_messages():
            references += raw.topic == topic
            if raw.topic != topic or references != 8:
                bag.write(raw.topic, raw.data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
    found = reexecute("controller", RecordedInputs(BagReader(tmp_path / "bag")))
    assert found.missing == 1
    assert found.first_difference is None and found.compared > 1000 and found.uncompared > 0


def test_topics_of_other_types_are_left_out(tmp_path: Path) -> None:
    reader, text = BagReader(SAMPLE), "std_msgs/msg/String"
    content = b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00"
    for topic in ("/safety_state", "/reference/pose", "/intake/observer"):
        directory = tmp_path / topic.replace("/", "_")
        types = {name: text if name == topic else known.type for name, known in reader.topics.items()}
        with BagWriter(directory, [RecordedTopic(name, kind) for name, kind in types.items()]) as bag:
            for raw in reader.raw_messages():
                data = content if raw.topic == topic else raw.data
                bag.write(raw.topic, data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
        read = BagReader(directory, of_stack=True)
        assert f"topic '{topic}': is {text}, expected" in read.notes[0]
        assert reexecute("controller", RecordedInputs(read)).first_difference is None
        assert Recording(directory).duration > 1.0


def test_other_settings_have_other_results(sample: RecordedInputs, tmp_path: Path) -> None:
    file, budget = tmp_path / "other.yaml", tmp_path / "budget.yaml"
    budget.write_text(f"torque_thresholds: {[0.5] * 7}\ntorque_per_speed: {[0.0] * 7}\n")
    limits = "controller: {ros__parameters: {limits: {torque_share: 0.05}}}"
    file.write_text(f"{limits}\nobserver: {{ros__parameters: {{contact_budget: {budget}}}}}\n")
    torques, residuals = reexecute("controller", sample, file), reexecute("observer", sample, file)
    assert torques.largest_difference > 40.0 - 0.05 * 320.0
    assert residuals.reasons[0].endswith("permitted 0.5 Nm")
    for found in (torques, residuals):
        assert found.first_difference is None and found.compared == 0


def test_what_is_missing_is_said(sample: RecordedInputs, tmp_path: Path) -> None:
    with pytest.raises(BagError, match="lacks the settings of the controller"):
        reexecute("controller", changed(sample, settings={}))
    without = copy.copy(sample.bag)
    without.messages = lambda name: iter(())
    with pytest.raises(BagError, match="lacks intake/observer"):
        reexecute("observer", changed(sample, bag=without))
    BagWriter(tmp_path / "bag").close()
    with pytest.raises(BagError, match="no joint states"):
        RecordedInputs(BagReader(tmp_path / "bag"))


@pytest.mark.parametrize(
    ("recorded", "differs"), [([], False), (["stop service called"], False), (["stop service called", "another"], True)]
)
def test_a_stop_may_be_the_last_thing_that_a_bag_has(
    sample: RecordedInputs, recorded: list[str], differs: bool
) -> None:
    """Whether the node still published it is a race."""
    intake = sample.intake("controller")
    (stop,) = np.flatnonzero(intake.rows["what"] == Taken.STOP)
    cut = intake._replace(rows=intake.rows[: stop + 1])
    found = reexecute("controller", changed(sample, intake=lambda _: cut, safety_reasons=lambda _: recorded))
    assert found.compared > 2500 and (found.first_difference is not None) == differs
