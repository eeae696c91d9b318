import shutil
from pathlib import Path

import pytest
import zstandard
from conftest import START_NS, STEP_NS, SampleBag
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError


@pytest.mark.parametrize("single_file", [False, True])
def test_it_reads_what_was_written(shared_sample: SampleBag, single_file: bool) -> None:
    written = shared_sample.written
    reader = BagReader(shared_sample.file if single_file else shared_sample.directory)
    assert {name: topic.type for name, topic in reader.topics.items()} == shared_sample.topics
    assert {topic.message_count for topic in reader.topics.values()} == {len(written) // 5}
    assert reader.message_count == len(written)
    assert reader.start_ns == START_NS
    assert reader.duration == pytest.approx((len(written) - 1) * STEP_NS * 1e-9)
    assert reader.custom_data == {"scene": "ball", "seed": "7"}
    assert reader.notes == ()
    read = [(raw.topic, raw.log_time_ns, raw.publish_time_ns, raw.data) for raw in reader.raw_messages()]
    assert read == [(topic, received, sent, data) for topic, received, sent, _, data in written]


def write_stacks(path: Path, *names: str) -> Path:
    """A bag with one message in each topic, which has the topic's name in a field."""
    made = {
        name: JointState(name=[name])
        if name.endswith("/joint_states")
        else DiagnosticStatus(name=name)
        if name.endswith("/state") or name.endswith("_state")
        else String(data=name)
        for name in names
    }
    kinds = {JointState: "sensor_msgs/msg/JointState", DiagnosticStatus: "diagnostic_msgs/msg/DiagnosticStatus"}
    recorded = [RecordedTopic(name, kinds.get(type(message), "std_msgs/msg/String")) for name, message in made.items()]
    with BagWriter(path, recorded) as writer:
        for name, message in made.items():
            writer.write(name, serialize_message(message), START_NS)
    return path


def test_topics_of_a_stack_go_without_its_namespace(tmp_path: Path) -> None:
    own = ["/a/left/joint_states", "/a/left/safety_state", "/a/left/goal/state"]
    others = {"/a/left_hand/camera", "/tf", "/gripper/joint_states"}
    bag = write_stacks(tmp_path / "bag", *own, *others)
    assert set(BagReader(bag).topics) == {*own, *others}
    reader = BagReader(bag, of_stack=True)
    assert set(reader.topics) == {"/joint_states", "/safety_state", "/goal/state", *others}
    (read,) = reader.messages("/goal/state")
    assert read.name == "/a/left/goal/state"


def test_those_of_others_that_have_no_namespace_stay_apart(tmp_path: Path) -> None:
    bag = write_stacks(tmp_path / "bag", "/joint_states", "/left/joint_states", "/left/safety_state")
    reader = BagReader(bag, of_stack=True)
    assert set(reader.topics) == {"/joint_states", "/safety_state", "/joint_states (outside /left)"}
    assert [read.name for read in reader.messages("/joint_states")] == [["/left/joint_states"]]


def test_topics_of_other_types_have_their_type_in_their_name(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", [RecordedTopic("/safety_state", "std_msgs/msg/String")]) as writer:
        writer.write("/safety_state", serialize_message(String(data="ok")), START_NS)
    reader = BagReader(tmp_path / "bag", of_stack=True)
    assert set(reader.topics) == {"/safety_state (std_msgs/msg/String)"}
    assert "'/safety_state': is std_msgs/msg/String, expected diagnostic_msgs/msg/DiagnosticStatus" in reader.notes[0]


def test_of_several_stacks_none_is_chosen(tmp_path: Path) -> None:
    names = ("/joint_states", "/safety_state")
    bag = write_stacks(tmp_path / "bag", *names, *(f"/left{name}" for name in names))
    with pytest.raises(BagError, match=r"several stacks: /, /left; expected one"):
        BagReader(bag, of_stack=True)


def test_bag_that_is_stored_otherwise(tmp_path: Path) -> None:
    (tmp_path / "sample_0.db3").write_bytes(b"SQLite format 3\0")
    for path, message in ((tmp_path, "no bag with mcap files; "), (tmp_path / "sample_0.db3", "is no mcap file .*")):
        with pytest.raises(BagError, match=f"{message}`ros2 bag convert`"):
            BagReader(path)


def test_a_file_that_is_compressed_as_a_whole_is_refused_with_what_to_do(sample: SampleBag) -> None:
    packed = sample.file.with_suffix(".mcap.zstd")
    packed.write_bytes(zstandard.compress(sample.file.read_bytes()))
    sample.file.unlink()
    for path in (sample.directory, packed):
        with pytest.raises(BagError, match=f"decompress it with `zstd -d {packed} -o {sample.file}`"):
            BagReader(path)


def test_one_beside_others_is_noted(sample: SampleBag) -> None:
    packed = sample.directory / "another_0.mcap.zstd"
    packed.write_bytes(zstandard.compress(sample.file.read_bytes()))
    reader = BagReader(sample.directory)
    assert reader.message_count and any(f"zstd -d {packed}" in note for note in reader.notes)
    # Of one that is there decompressed as well there is nothing to say.
    packed.rename(sample.file.with_suffix(".mcap.zstd"))
    assert BagReader(sample.directory).notes == ()


def test_files_whose_times_overlap_are_read_in_the_order_of_reception(tmp_path: Path) -> None:
    first, second = SampleBag(tmp_path / "first", 40), SampleBag(tmp_path / "second", 60)
    shutil.copy(second.file, first.directory / "first_1.mcap")
    received = [raw.log_time_ns for raw in BagReader(first.directory).raw_messages()]
    assert len(received) == 100 and received == sorted(received)


def test_bag_in_several_files_without_metadata(tmp_path: Path) -> None:
    first, second = SampleBag(tmp_path / "first", 40), SampleBag(tmp_path / "second", 60)
    shutil.copy(second.file, first.directory / "first_1.mcap")
    (first.directory / "first_2.mcap").touch()
    (first.directory / "metadata.yaml").unlink()
    reader = BagReader(first.directory)
    assert reader.message_count == len(list(map(reader.decode, reader.raw_messages()))) == 100
    (note,) = reader.notes
    assert "first_2.mcap: is empty" in note


def test_names_of_files_and_what_metadata_yaml_says_do_not_count(sample: SampleBag) -> None:
    """A bag may have been renamed, reindexed or converted."""
    sample.file.rename(sample.directory / "monday.mcap")
    entries = "storage_identifier: '', relative_file_paths: [sample/sample_0.mcap.zstd], compression_mode: NONE"
    for text in (f"rosbag2_bagfile_information: {{{entries}}}", "[", ""):
        (sample.directory / "metadata.yaml").write_text(text)
        reader = BagReader(sample.directory)
        assert [raw.data for raw in reader.raw_messages()] == [data for *_, data in sample.written]
        assert reader.notes == ()


def chunk_ends(path: Path) -> list[int]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [chunk.chunk_start_offset + chunk.chunk_length for chunk in summary.chunk_indexes]


@settings(max_examples=30)
@given(fraction=st.floats(0.0, 1.0, exclude_max=True), zeros=st.sampled_from([0, 0, 1, 9, 5000]))
def test_cut_file_is_readable_up_to_the_cut(
    shared_sample: SampleBag, tmp_path_factory: pytest.TempPathFactory, fraction: float, zeros: int
) -> None:
    """Also if zeros follow, as where the power failed before the file system had written the rest."""
    whole = shared_sample.file.read_bytes()
    path = tmp_path_factory.mktemp("cut") / "cut.mcap"
    length = int(fraction * len(whole))
    path.write_bytes(whole[:length] + bytes(zeros))
    if length < 8:
        with pytest.raises(BagError):
            BagReader(path)
        return
    reader = BagReader(path)
    read = [(raw.topic, raw.log_time_ns, raw.data) for raw in reader.raw_messages()]
    expected = [(topic, received, data) for topic, received, _, _, data in shared_sample.written]
    assert read == expected[: len(read)]
    assert reader.message_count == len(read)
    assert f"of {length + zeros}" in reader.notes[0]
    # The fixture writes a chunk for every 40 messages, and none of those that are whole may be given up.
    whole_chunks = [end for end in chunk_ends(shared_sample.file) if end <= length]
    assert len(read) == 40 * len(whole_chunks)


def test_damaged_chunk_is_left_out_and_the_rest_read(sample: SampleBag) -> None:
    content = bytearray(sample.file.read_bytes())
    first_end, second_end = chunk_ends(sample.file)[:2]
    content[(first_end + second_end) // 2 + 200] ^= 255
    for whole in (True, False):
        sample.file.write_bytes(content if whole else content[:-100])
        reader = BagReader(sample.directory)
        read = [raw.log_time_ns for raw in reader.raw_messages()]
        assert read == [entry[1] for number, entry in enumerate(sample.written) if not 40 <= number < 80]
        assert any("1 chunks are damaged" in note for note in reader.notes)


@settings(max_examples=20)
@given(position=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_damaged_file_gives_messages_or_an_error_that_names_it(
    shared_sample: SampleBag, tmp_path_factory: pytest.TempPathFactory, position: float, flip: int
) -> None:
    content = bytearray(shared_sample.file.read_bytes())
    content[int(position * len(content))] ^= flip
    path = tmp_path_factory.mktemp("damaged") / "damaged.mcap"
    path.write_bytes(content)
    try:
        reader = BagReader(path)
        read = list(map(reader.decode, reader.raw_messages()))
    except BagError as error:
        assert "damaged.mcap" in str(error)
    else:
        assert len(read) <= len(shared_sample.written)


def test_what_cannot_be_decoded_does_not_keep_others_from_being_read(tmp_path: Path) -> None:
    path = tmp_path / "strange.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="")
        text = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        unknown = writer.register_schema("arm_msgs/msg/Gain", "ros2msg", b"arm_msgs/Missing gain\n")
        other = writer.register_schema("arm_msgs/msg/Other", "protobuf", b"\1")
        channels = [
            writer.register_channel("/gain", "cdr", unknown),
            writer.register_channel("/text", "cdr", text),
            writer.register_channel("/other", "cdr", other),
            writer.register_channel("/json", "json", text),
        ]
        writer.add_message(writer.register_channel("/any", "json", 0), 0, b"{}", 0)
        writer.add_attachment(0, 0, "note.txt", "text/plain", b"seen on Monday")
        for time in range(8):
            data = serialize_message(String(data=str(time)))
            writer.add_message(channels[time % 4], time, data, time)
        writer.add_message(channels[1], 8, serialize_message(JointState())[:9], 8)
        writer.finish()
    reader = BagReader(path)
    assert [text.data for name in reader.topics for text in reader.messages(name)] == ["1", "5"]
    for topic, count in {"/gain": 2, "/other": 2, "/json": 2, "/any": 1, "/text": 1}.items():
        assert any(note.startswith(f"topic '{topic}': {count} messages are left out") for note in reader.notes)
