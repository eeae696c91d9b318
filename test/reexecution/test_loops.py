"""Re-execution of the bag that comes with the package: identical as it is, exact about what differs when it is not."""

import dataclasses
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.intake import BATCH, COLUMNS, IntakeLog, Taken
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.loops import _ControllerLoop, reexecute
from contact_reach_ros.reexecution.settings import ChangedSettings
from contact_reach_ros.resources import share_directory

SAMPLE = share_directory() / "bags" / "sample"


@pytest.fixture(scope="module")
def sample() -> RecordedInputs:
    return RecordedInputs(BagReader(SAMPLE))


def changed(directory: Path, change: Callable[[int, RawMessage], RawMessage | None]) -> RecordedInputs:
    """The sample with other messages: `change` gets the number of each within its topic."""
    reader = BagReader(SAMPLE)
    counts: dict[str, int] = {}
    with BagWriter(directory, [RecordedTopic(name, topic.type) for name, topic in reader.topics().items()]) as writer:
        for raw in reader.raw_messages():
            counts[raw.topic] = counts.get(raw.topic, 0) + 1
            kept = change(counts[raw.topic], raw)
            if kept is not None:
                writer.write(kept.topic, kept.data, kept.log_time_ns, kept.publish_time_ns, kept.sequence)
    return RecordedInputs(BagReader(directory))


def test_torques_and_residuals_are_identical(sample: RecordedInputs) -> None:
    for found in (reexecute("controller", sample), reexecute("observer", sample)):
        assert found.compared > 3000
        assert found.largest_difference <= 1e-9
        assert found.first_difference is None
        assert found.notes == ()


def test_the_first_difference_is_named(tmp_path: Path) -> None:
    def change(number: int, raw: RawMessage) -> RawMessage:
        if raw.topic != "/effort_controller/commands" or number < 2000:
            return raw
        # A3 is the third of the seven numbers behind the header.
        data = bytearray(raw.data)
        (torque,) = struct.unpack_from("<d", data, 20 + 2 * 8)
        struct.pack_into("<d", data, 20 + 2 * 8, torque + 1e-6)
        return raw._replace(data=bytes(data))

    inputs = changed(tmp_path / "bag", change)
    first = reexecute("controller", inputs).first_difference
    assert first is not None
    assert first.tick == int(inputs.columns["effort_controller/commands"].sequence[1999])
    assert first.field == "effort_controller/commands of lbr_A3"
    assert float(first.recorded) - float(first.reexecuted) == pytest.approx(1e-6, rel=1e-3)


def test_after_lost_messages_it_finds_into_step_again(tmp_path: Path) -> None:
    def change(number: int, raw: RawMessage) -> RawMessage | None:
        return None if raw.topic == "/joint_states" and 1500 <= number < 1550 else raw

    inputs = changed(tmp_path / "bag", change)
    for found in (reexecute("controller", inputs), reexecute("observer", inputs)):
        assert found.first_difference is None
        assert found.compared > 2900
        assert any(note.startswith("50 messages that the") for note in found.notes)


def test_other_settings_have_other_results(sample: RecordedInputs, tmp_path: Path) -> None:
    file = tmp_path / "other.yaml"
    file.write_text("controller: {ros__parameters: {limits: {torque_share: 0.05}}}\nmodel: {ros__parameters: {}}\n")
    found = reexecute("controller", sample, ChangedSettings(file))
    assert np.abs(found.values[:, 1]).max() == pytest.approx(0.05 * 320.0)
    assert np.nanmax(np.abs(found.recorded[:, 1])) > 40.0
    assert found.first_difference is None and found.compared == 0


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    def without(topic: str) -> Callable[[int, RawMessage], RawMessage | None]:
        return lambda _, raw: None if raw.topic == topic else raw

    with pytest.raises(BagError, match="lacks the settings of the controller"):
        reexecute("controller", changed(tmp_path / "settings", without("/settings")))
    with pytest.raises(BagError, match="lacks intake/observer"):
        reexecute("observer", changed(tmp_path / "intake", without("/intake/observer")))
    with pytest.raises(BagError, match="no joint states"):
        changed(tmp_path / "states", without("/joint_states"))


@pytest.mark.parametrize("later", [0, 1])
@pytest.mark.parametrize(
    ("recorded", "differs"), [([], False), (["stop service called"], False), (["stop service called", "another"], True)]
)
def test_a_stop_may_be_the_last_thing_that_a_bag_has(
    sample: RecordedInputs, later: int, recorded: list[str], differs: bool
) -> None:
    """Whether the node still published it is a race, also with one more joint state, whose outcome is not known."""
    loop = _ControllerLoop(sample, ChangedSettings())
    rows = loop.intake.rows
    (stop,) = np.flatnonzero(rows[:, 0] == Taken.STOP)
    loop.intake = dataclasses.replace(loop.intake, rows=rows[: stop + 1 + later])
    loop.recorded_reasons = recorded
    found = loop.run()
    assert found.compared > 3000 and (found.first_difference is not None) == differs


def rows(batches: list[bytes]) -> Iterator[list[int]]:
    for batch in batches:
        (count,) = struct.unpack_from("<I", batch, 12)
        assert len(batch) == 20 + 8 * count
        yield list(struct.unpack_from(f"<{count}q", batch, 20))


def test_intake_comes_in_numbered_batches() -> None:
    batches: list[bytes] = []
    log = IntakeLog(batches.append)
    for number in range(BATCH + 2):
        log.add(Taken.JOINT_STATES, 1000 + number, 2000 + number)
        log.outputs += 1
        log.publish_full()
    assert len(batches) == 1
    log.flush()
    log.flush()
    first, second = rows(batches)
    width = len(COLUMNS)
    assert first[0] == 0 and len(first) == 1 + width * BATCH
    assert second == [BATCH, 1, 1000 + BATCH, 2000 + BATCH, BATCH, 1, 1001 + BATCH, 2001 + BATCH, BATCH + 1]


def test_a_full_batch_waits_for_a_good_moment_but_nothing_is_lost() -> None:
    batches: list[bytes] = []
    log = IntakeLog(batches.append)
    for number in range(BATCH):
        log.add(Taken.JOINT_STATES, number, number)
    assert not batches
    for number in range(BATCH, 3 * BATCH):
        log.add(Taken.JOINT_STATES, number, number)
    log.flush()
    ((first, *values),) = rows(batches)
    assert first == 0 and values[1 :: len(COLUMNS)] == list(range(3 * BATCH))
