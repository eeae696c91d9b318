"""Where the messages of a bag lie, and those of one layout as one array: for bags too long to decode.

A ten-minute bag has millions of messages. The index of an mcap file tells where each is; so a topic whose messages
differ in numbers only is read chunk by chunk with NumPy, and of the others only those that are asked for.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from contact_reach_ros.errors import BagError

Times = NDArray[np.int64]
Bytes = NDArray[np.uint8]

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_PAIR = np.dtype([("time", "<u8"), ("offset", "<u8")])
_MESSAGE_HEAD = 31
"""Opcode, length, channel, sequence and the two times before a message's own bytes."""
_MESSAGE_FIXED = 22
_OPEN_CHUNKS = 8


class Rows(NamedTuple):
    """Messages of one topic in one chunk.

    Attributes
    ----------
    times
        (n,) of reception, ns since the epoch.
    data
        (n, size) their bytes, the encapsulation header included; rows end with zeros where messages are shorter.
    sizes
        (n,) number of bytes of each.
    """

    times: Times
    data: Bytes
    sizes: NDArray[np.int64]


class BagIndex:
    """The index of a bag.

    Parameters
    ----------
    files
        Its mcap files, all of them complete.

    Raises
    ------
    BagError
        If one of them has no index.
    """

    def __init__(self, files: Collection[Path]) -> None:
        self._topics: dict[tuple[Path, int], str] = {}
        self._chunks: list[tuple[Path, ChunkIndex]] = []
        for file in files:
            with file.open("rb") as stream:
                summary = SeekingReader(stream).get_summary()
            if summary is None:
                raise BagError(f"{file}: has no index")
            self._topics |= {(file, number): channel.topic for number, channel in summary.channels.items()}
            self._chunks += [(file, index) for index in summary.chunk_indexes]
        self._chunks.sort(key=lambda entry: entry[1].message_start_time)
        self._open: OrderedDict[int, Bytes] = OrderedDict()

    def scan(
        self, whole: Collection[str], placed: Collection[str]
    ) -> Iterator[tuple[int, Mapping[str, Rows], Mapping[str, NDArray[np.void]]]]:
        """Go through all chunks once.

        Parameters
        ----------
        whole
            Topics whose messages are wanted as arrays.
        placed
            Topics of which only places are wanted.

        Yields
        ------
        tuple
            Number of the chunk, rows of each topic of `whole` that is in it, and pairs of times and offsets (n,) of
            each topic of `placed`.

        Raises
        ------
        BagError
            If the file is damaged.
        """
        for number, (file, index) in enumerate(self._chunks):
            wanted = {
                channel: topic
                for channel in index.message_index_offsets
                if (topic := self._topics.get((file, channel), "")) in whole or topic in placed
            }
            if not wanted:
                continue
            try:
                pairs = self._pairs(file, index, wanted)
                content = self._content(number) if any(topic in whole for topic in wanted.values()) else None
                rows = {
                    wanted[channel]: _rows(content, pair)
                    for channel, pair in pairs.items()
                    if content is not None and wanted[channel] in whole and len(pair)
                }
            except (McapError, zstandard.ZstdError, struct.error, ValueError, IndexError) as error:
                raise BagError(f"{file}: is damaged at byte {index.chunk_start_offset}: {error}") from error
            yield number, rows, {wanted[channel]: pair for channel, pair in pairs.items() if wanted[channel] in placed}

    def message(self, chunk: int, offset: int) -> bytes:
        """The bytes of the message at a place.

        Raises
        ------
        BagError
            If the file is damaged.
        """
        try:
            content = self._content(chunk)
            (length,) = struct.unpack_from("<Q", content[offset + 1 : offset + 9].tobytes())
            return content[offset + _MESSAGE_HEAD : offset + _MESSAGE_HEAD + length - _MESSAGE_FIXED].tobytes()
        except (zstandard.ZstdError, struct.error, ValueError) as error:
            file, index = self._chunks[chunk]
            raise BagError(f"{file}: is damaged at byte {index.chunk_start_offset}: {error}") from error

    def _pairs(self, file: Path, index: ChunkIndex, wanted: Collection[int]) -> dict[int, NDArray[np.void]]:
        start = min(index.message_index_offsets.values())
        with file.open("rb") as stream:
            stream.seek(start)
            data = stream.read(index.message_index_length)
        found = {}
        for channel in wanted:
            at = index.message_index_offsets[channel] - start + _RECORD.size
            number, size = struct.unpack_from("<HI", data, at)
            if number != channel:
                raise ValueError(f"the index of channel {channel} is that of channel {number}")
            pairs = np.frombuffer(data, _PAIR, size // _PAIR.itemsize, at + 6)
            found[channel] = pairs[np.argsort(pairs["time"], kind="stable")]
        return found

    def _content(self, number: int) -> Bytes:
        """The records of a chunk, unpacked; the last few are kept."""
        if number in self._open:
            self._open.move_to_end(number)
            return self._open[number]
        file, index = self._chunks[number]
        with file.open("rb") as stream:
            stream.seek(index.chunk_start_offset)
            record = stream.read(index.chunk_length)
        _, _, size, _ = _CHUNK.unpack_from(record, _RECORD.size)
        at = _RECORD.size + _CHUNK.size
        (name_length,) = struct.unpack_from("<I", record, at)
        compression = record[at + 4 : at + 4 + name_length].decode()
        data = memoryview(record)[at + 4 + name_length + 8 :]
        if compression == "zstd":
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)  # type: ignore[assignment]
        elif compression == "lz4":
            import lz4.frame

            data = lz4.frame.decompress(data)
        elif compression:
            raise ValueError(f"its compression is {compression}; expected zstd, lz4 or none")
        content = np.frombuffer(data, np.uint8)
        self._open[number] = content
        if len(self._open) > _OPEN_CHUNKS:
            self._open.popitem(last=False)
        return content


def _rows(content: Bytes, pairs: NDArray[np.void]) -> Rows:
    offsets = pairs["offset"].astype(np.int64)
    lengths = content[offsets[:, None] + np.arange(1, 9)].copy().view("<u8")[:, 0].astype(np.int64) - _MESSAGE_FIXED
    if lengths.min() < 0 or (offsets + _MESSAGE_HEAD + lengths).max() > len(content):
        raise ValueError("a message ends behind its chunk")
    columns = np.arange(lengths.max())
    places = offsets[:, None] + _MESSAGE_HEAD + columns
    data = content[np.minimum(places, len(content) - 1)]
    data[columns >= lengths[:, None]] = 0
    return Rows(pairs["time"].astype(np.int64), data, lengths)


class JointColumns:
    """Numbers out of rows of serialised JointState messages, as columns."""

    def __init__(self, names: Collection[str], fields: Collection[str]) -> None:
        """`names`: the wanted joints or links, in order; `fields`: of position, velocity, effort."""
        self._names = list(names)
        self._fields = list(fields)
        self._times: list[Times] = []
        self._stamps: list[Times] = []
        self._values: list[NDArray[np.float64]] = []

    def add(self, rows: Rows) -> None:
        """Take the messages of a chunk; what is no JointState is left out."""
        order = np.arange(len(rows.times))
        for size in np.unique(rows.sizes):
            chosen = order[rows.sizes == size]
            while len(chosen):
                layout = _layout(rows.data[chosen[0], :size].tobytes())
                if layout is None:
                    chosen = chosen[1:]
                    continue
                like = (rows.data[chosen][:, layout.fixed] == rows.data[chosen[0], layout.fixed]).all(axis=1)
                self._take(rows, chosen[like], layout)
                chosen = chosen[~like]

    def result(self) -> tuple[Times, Times, NDArray[np.float64]]:
        """Times of reception and stamps, (n,) ns, and values (n, fields, names), NaN where a message has none."""
        if not self._times:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, len(self._fields), len(self._names)))
        times = np.concatenate(self._times)
        order = np.argsort(times, kind="stable")
        return times[order], np.concatenate(self._stamps)[order], np.concatenate(self._values)[order]

    def _take(self, rows: Rows, chosen: NDArray[np.intp], layout: _Layout) -> None:
        names, starts = layout.names, layout.starts
        data = rows.data[chosen]
        stamp = np.ascontiguousarray(data[:, 4:12])
        seconds, nanoseconds = stamp.view("<i4")[:, 0].astype(np.int64), stamp.view("<u4")[:, 1].astype(np.int64)
        values = np.full((len(chosen), len(self._fields), len(self._names)), np.nan)
        shared = [(column, names.index(name)) for column, name in enumerate(self._names) if name in names]
        for row, field in enumerate(self._fields):
            if field in starts and shared:
                numbers = np.ascontiguousarray(data[:, starts[field] : starts[field] + 8 * len(names)]).view("<f8")
                into, source = zip(*shared, strict=True)
                values[:, row, into] = numbers[:, source]
        self._times.append(rows.times[chosen])
        self._stamps.append(seconds * 1_000_000_000 + nanoseconds)
        self._values.append(values)


class _Layout(NamedTuple):
    """Of a serialised JointState."""

    names: tuple[str, ...]
    starts: dict[str, int]
    """Where the numbers begin of the fields that have one for each name."""
    fixed: NDArray[np.intp]
    """The bytes that say where everything is: between fields there may be gaps, in which anything may stand."""


def _layout(data: bytes) -> _Layout | None:
    """The layout of a message; None if it is no JointState."""
    if len(data) < 16 or data[:2] != b"\x00\x01":
        return None
    fixed = [np.arange(4)]
    at = 12

    def count() -> int:
        nonlocal at
        at += -(at - 4) % 4
        (number,) = struct.unpack_from("<I", data, at)
        fixed.append(np.arange(at, at + 4))
        at += 4
        return int(number)

    def text() -> str:
        nonlocal at
        length = count()
        content = data[at : at + length]
        if len(content) < length:
            raise ValueError("a text that ends behind the message")
        fixed.append(np.arange(at, at + length))
        at += length
        return content.rstrip(b"\0").decode()

    try:
        text()
        names = tuple(text() for _ in range(count()))
        starts = {}
        for field in ("position", "velocity", "effort"):
            number = count()
            if number:
                # CDR aligns numbers to their size, counted from behind its header of four bytes.
                at += -(at - 4) % 8
                if number == len(names):
                    starts[field] = at
                at += 8 * number
    except (struct.error, ValueError):
        return None
    return _Layout(names, starts, np.concatenate(fixed)) if at <= len(data) else None
