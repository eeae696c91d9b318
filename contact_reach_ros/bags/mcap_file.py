"""mcap files: their contents, and their messages by time of reception.

The `mcap` package reads the records. A file is opened by its index; one without a complete index, such as that of a
recorder that was killed or whose disk was full, is read up to its end, or to where it is cut. Chunks are read one by
one, since `SeekingReader.iter_messages` gives up the whole file for a damaged one, and their messages together, since
an hour of a 1 kHz arm has ten million.
"""

from __future__ import annotations

import shlex
import struct
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from functools import lru_cache
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from contact_reach_ros.errors import BagError
from contact_reach_ros.timing import NANOSECONDS

_DAMAGE = (McapError, struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError, OSError)
"""Errors of the libraries where a file is cut or damaged: in a record, a number, a chunk (zstd, lz4), a text, or an
impossible length."""
_MESSAGE = int(Opcode.MESSAGE)
_DEFINITIONS: dict[int, type[Schema] | type[Channel]] = {int(Opcode.SCHEMA): Schema, int(Opcode.CHANNEL): Channel}
_ZSTD_MAGIC = bytes.fromhex("28b52ffd")
_RECORD = struct.Struct("<BQ")
"""Opcode and length before the content of a record."""
_HEAD = np.dtype(
    {
        "names": ("length", "channel", "sequence", "log_ns", "publish_ns"),
        "formats": ("<u8", "<u2", "<u4", "<u8", "<u8"),
        "offsets": (1, 9, 11, 15, 23),
    }
)
"""What precedes the data of a message, after the opcode."""
MESSAGES = np.dtype([("topic", "i4"), ("log_ns", "i8"), ("publish_ns", "i8"), ("data", "O"), ("sequence", "i8")])
"""Messages: number of the topic, times of reception and of sending in ns since the epoch, serialized message, and its
publisher's number."""
Messages = NDArray[np.void]

_INDEX_BYTES, _ENTRY_BYTES = 15, 16
"""Bytes of a chunk's index of the messages of one channel, without its entries, and of an entry."""
_MOST_LOOSE = 1 << 20
"""Bytes of messages outside of chunks that are read at once."""
_MOST = 10_000
"""Messages that are handed out at once."""
_ASTRAY_NS = 366 * 24 * 3600 * NANOSECONDS
"""Time from the middle message of a file from which on a message was not received when the file has it, ns."""


class _Chunk(NamedTuple):
    """Place in the file, reception of the first and last message, ns, and channels; these are empty if not known."""

    start: int
    first_ns: int
    last_ns: int
    channels: Set[int]
    loose: int = 0
    """Size in bytes, if it is no chunk, but messages one after the other outside of chunks."""


class _Content(NamedTuple):
    """What a chunk holds: bytes, and place and head (n,) of each message in the order of the file."""

    bytes: bytes
    starts: NDArray[np.intp]
    heads: NDArray[np.void]


class McapFile:
    """A recording in one mcap file.

    Raises `BagError` if the file is missing, empty, or no mcap file.

    Attributes
    ----------
    schemas, channels :
        By their number in the file.
    message_counts :
        Messages by channel number.
    span_ns :
        Times of reception of the first and of the last message, ns since the epoch; None without messages.
    metadata :
        Metadata records by name; the last one of a name counts.
    chunks :
        By the time of their first messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.message_counts: Counter[int] = Counter()
        self.metadata: dict[str, dict[str, str]] = {}
        self.chunks: list[_Chunk] = []
        self._cut_at: int | None = None
        self._damaged: set[int] = set()
        self._possible_ns = 0, (1 << 64) - 1
        """Times of reception outside of which messages are left out, ns."""
        self._astray = 0
        try:
            with path.open("rb") as stream:
                beginning = stream.read(len(MCAP0_MAGIC))
            self._size = path.stat().st_size
        except OSError as error:
            raise BagError(f"{path}: cannot be opened: {error.strerror}") from error
        if not beginning:
            raise BagError(f"{path}: is empty; the recording stopped before anything was written")
        if beginning.startswith(_ZSTD_MAGIC):
            command = f"zstd -d {shlex.quote(str(path))} -o {shlex.quote(str(path.with_suffix('')))}"
            raise BagError(f"{path}: is compressed as a whole file; decompress it with `{command}`")
        if beginning != MCAP0_MAGIC:
            raise BagError(
                f"{path}: is no mcap file (its first bytes are {beginning.hex(' ')}); "
                "`ros2 bag convert` can convert other recordings"
            )
        if not self._open_by_index():
            self._scan()
        self.chunks.sort(key=attrgetter("first_ns", "start"))
        self.span_ns: tuple[int, int] | None = None
        if self.chunks:
            self.span_ns = self.chunks[0].first_ns, max(chunk.last_ns for chunk in self.chunks)
            if self.span_ns[1] - self.span_ns[0] > _ASTRAY_NS:
                self.span_ns = self._leave_out_astray()
        # The next request often lies close by: the viewer reads topic by topic and moment by moment.
        self._read_cached = lru_cache(4)(self._read)

    def notes(self) -> Iterator[str]:
        """Yield a sentence about each kind of defect found so far."""
        name = self.path.name
        if self._cut_at is not None:
            yield f"{name} is cut or damaged: readable up to byte {self._cut_at} of {self._size}"
        if self._damaged:
            yield f"{name}: {len(self._damaged)} chunks are damaged, their messages are left out"
        if self._astray:
            yield f"{name}: {self._astray} messages are left out, received more than a year before or after the others"

    def read(self, chunk: _Chunk, numbers: NDArray[np.int32], start_ns: int) -> Messages:
        """The messages (n,) of a chunk, received from `start_ns` on; `numbers` are those of the topics by channel.

        In the order of the file, without those of topics with a negative number. A damaged chunk has none.
        """
        content, starts, heads = self._read_cached(chunk.start, chunk.loose)
        topics, received = numbers[heads["channel"]], heads["log_ns"]
        first_ns, last_ns = self._possible_ns
        rows = np.flatnonzero((topics >= 0) & (received >= max(start_ns, first_ns)) & (received <= last_ns))
        found = np.empty(len(rows), MESSAGES)
        found["topic"] = topics[rows]
        for name in ("log_ns", "publish_ns", "sequence"):
            found[name] = heads[name][rows]
        begins, ends = starts + _HEAD.itemsize, starts + _RECORD.size + heads["length"].astype(np.intp)
        found["data"] = [content[begin:end] for begin, end in zip(begins[rows], ends[rows], strict=True)]
        return found

    def _open_by_index(self) -> bool:
        """Take contents and chunks from the summary; returns False if it is missing, damaged or incomplete."""
        try:
            with self.path.open("rb") as stream:
                reader = SeekingReader(stream, record_size_limit=self._size)
                summary = reader.get_summary()
                if summary is None or summary.statistics is None:
                    return False
                metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        except _DAMAGE:
            return False
        counts, chunks = summary.statistics.channel_message_counts, summary.chunk_indexes
        types = {channel.schema_id for channel in summary.channels.values()}
        complete = counts.keys() <= summary.channels.keys() and types <= summary.schemas.keys()
        indexed = sum(c.message_index_length - _INDEX_BYTES * len(c.message_index_offsets) for c in chunks)
        # Others are outside of chunks, or the writer made no index.
        complete = complete and (not indexed or indexed == _ENTRY_BYTES * summary.statistics.message_count)
        # Any other chunk is empty, or has messages that were received at 0.
        complete = complete and all(c.message_index_offsets or c.message_end_time for c in chunks)
        if not complete or len(chunks) != summary.statistics.chunk_count or not chunks:
            return False
        self.schemas, self.channels, self.metadata = summary.schemas, summary.channels, metadata
        self.message_counts.update(counts)
        self.chunks = [
            _Chunk(c.chunk_start_offset, c.message_start_time, c.message_end_time, c.message_index_offsets.keys())
            for c in chunks
        ]
        return True

    def _scan(self) -> None:
        """Go through the file to its end, or to where it is cut."""
        end = len(MCAP0_MAGIC)
        with self.path.open("rb") as stream:
            try:
                for record in StreamReader(stream, emit_chunks=True, record_size_limit=self._size).records:
                    start, end = end, stream.tell()
                    if isinstance(record, Message):
                        self.message_counts[record.channel_id] += 1
                        follows = bool(self.chunks) and 0 < self.chunks[-1].loose < _MOST_LOOSE
                        run = self.chunks.pop() if follows else _Chunk(start, record.log_time, 0, frozenset())
                        ends_ns = min(run.first_ns, record.log_time), max(run.last_ns, record.log_time)
                        self.chunks.append(_Chunk(run.start, *ends_ns, frozenset(), end - run.start))
                    elif isinstance(record, Metadata):
                        self.metadata[record.name] = record.metadata
                    elif isinstance(record, Chunk):
                        channels = self._break_up(record, start).heads["channel"]
                        found = Counter(channels.tolist())
                        self.message_counts += found
                        if found:
                            span_ns = record.message_start_time, record.message_end_time
                            self.chunks.append(_Chunk(start, *span_ns, found.keys()))
                    else:
                        self._define(record)
            except _DAMAGE:
                self._cut_at = end

    def _read(self, start: int, loose: int) -> _Content:
        """Read the chunk at byte `start`, or so many bytes from there; a damaged chunk has no messages."""
        try:
            with self.path.open("rb") as stream:
                if loose:
                    stream.seek(start)
                    return self._split(stream.read(loose))
                stream.seek(start + _RECORD.size)
                chunk = Chunk.read(ReadDataStream(stream))
        except _DAMAGE:
            self._damaged.add(start)
            return self._split(b"")
        return self._break_up(chunk, start)

    def _leave_out_astray(self) -> tuple[int, int]:
        """Leave out messages received long before or after the middle one; returns the span of the others, ns."""
        contents = (self._read(chunk.start, chunk.loose) for chunk in self.chunks)
        received = np.sort(np.concatenate([content.heads["log_ns"] for content in contents]))
        middle = int(received[len(received) // 2]) if len(received) else 0
        self._possible_ns = max(middle - _ASTRAY_NS, 0), min(middle + _ASTRAY_NS, (1 << 64) - 1)
        kept = received[(received >= self._possible_ns[0]) & (received <= self._possible_ns[1])]
        self._astray = len(received) - len(kept)
        return (int(kept[0]), int(kept[-1])) if len(kept) else (middle, middle)

    def _break_up(self, chunk: Chunk, start: int) -> _Content:
        """Take the definitions in a chunk and find its messages; a damaged one has none."""
        try:
            stream, size = get_chunk_data_stream(chunk, validate_crc=True)
            return self._split(stream.read(size))
        except _DAMAGE:
            self._damaged.add(start)
            return self._split(b"")

    def _split(self, content: bytes) -> _Content:
        """Take the definitions in a sequence of records and find its messages; raises `EndOfFile` if it is cut."""
        starts, at, size, head, least = [], 0, len(content), _RECORD.size, _HEAD.itemsize
        while at < size:
            opcode, length = _RECORD.unpack_from(content, at)
            start, at = at, at + head + length
            if at > size or (opcode == _MESSAGE and head + length < least):
                raise EndOfFile
            if opcode == _MESSAGE:
                starts.append(start)
            elif opcode in _DEFINITIONS:
                self._define(_DEFINITIONS[opcode].read(ReadDataStream(BytesIO(content[start + head : at]))))
        places = np.array(starts, np.intp)
        heads = np.frombuffer(content, np.uint8)[places[:, None] + np.arange(_HEAD.itemsize)].view(_HEAD)[:, 0]
        return _Content(content, places, heads)

    def _define(self, record: object) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)


def in_order(files: Sequence[McapFile], topics: Sequence[str], start_ns: int = 0) -> Iterator[Messages]:
    """Yield the messages of topics of files by time of reception, up to `_MOST` at once, from a time in ns on.

    Messages are held back only as long as a later chunk may have older ones; those of one time stay in the order of the
    files. Damaged chunks are left out.
    """
    waiting = np.empty(0, MESSAGES)
    chunks = ((chunk, file) for file in files for chunk in file.chunks if chunk.last_ns >= start_ns)
    numbers = {}
    for file in files:
        numbers[file] = np.full(1 << 16, -1, np.int32)
        for channel in file.channels.values():
            if channel.topic in topics:
                numbers[file][channel.id] = topics.index(channel.topic)
    for chunk, file in sorted(chunks, key=lambda entry: (entry[0].first_ns, entry[0].start)):
        if chunk.channels and (numbers[file][list(chunk.channels)] < 0).all():
            continue
        ready = int(np.searchsorted(waiting["log_ns"], min(chunk.first_ns, np.iinfo(np.int64).max)))
        yield from _parts(waiting[:ready])
        waiting = np.concatenate([waiting[ready:], file.read(chunk, numbers[file], start_ns)])
        waiting = waiting[np.argsort(waiting["log_ns"], kind="stable")]
    yield from _parts(waiting)


def _parts(messages: Messages) -> Iterator[Messages]:
    return (messages[first : first + _MOST] for first in range(0, len(messages), _MOST))
