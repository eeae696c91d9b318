"""Where the messages of a bag lie, for looking at some of them: a ten-minute bag has millions, too long to decode."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from mcap.reader import SeekingReader
from mcap.records import ChunkIndex

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording.bag_reader import BagReader
from contact_reach_ros.recording.mcap_chunks import DAMAGE, Block, read_blocks, read_chunk

_OPEN_CHUNKS = 8


class Place(NamedTuple):
    """Where a message is: number of the chunk, and start and size in its content."""

    chunk: int
    start: int
    size: int


class BagIndex:
    """A bag whose files are complete.

    Parameters
    ----------
    files
        Its mcap files.

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
        self._open: OrderedDict[int, bytes] = OrderedDict()

    def scan(self, topics: Collection[str]) -> Iterator[tuple[int, Mapping[str, Block]]]:
        """Go through all chunks once: number of the chunk, and the messages of each topic that is in it.

        Raises
        ------
        BagError
            If a file is damaged.
        """
        for number, (file, index) in enumerate(self._chunks):
            wanted = {
                channel: topic
                for channel in index.message_index_offsets
                if (topic := self._topics.get((file, channel), "")) in topics
            }
            if not wanted:
                continue
            try:
                with file.open("rb") as stream:
                    blocks = read_blocks(stream, index, wanted)
            except DAMAGE as error:
                raise self._damaged(number, error) from error
            yield number, {wanted[channel]: block for channel, block in blocks.items()}

    def message(self, place: Place) -> bytes:
        """The data of the message at a place.

        Raises
        ------
        BagError
            If the file is damaged.
        """
        if place.chunk in self._open:
            self._open.move_to_end(place.chunk)
        else:
            file, index = self._chunks[place.chunk]
            try:
                with file.open("rb") as stream:
                    self._open[place.chunk] = read_chunk(stream, index)
            except DAMAGE as error:
                raise self._damaged(place.chunk, error) from error
            if len(self._open) > _OPEN_CHUNKS:
                self._open.popitem(last=False)
        return self._open[place.chunk][place.start : place.start + place.size]

    def _damaged(self, number: int, error: Exception) -> BagError:
        file, index = self._chunks[number]
        return BagError(f"{file}: is damaged at byte {index.chunk_start_offset}: {error}")


class UnindexedBag:
    """A bag whose recording was not closed: read message by message, and kept. Used as `BagIndex`."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._blocks: list[Block] = []

    def scan(self, topics: Collection[str]) -> Iterator[tuple[int, Mapping[str, Block]]]:
        """As `BagIndex.scan`; each topic is a chunk of its own."""
        found: dict[str, list[tuple[int, int, int, bytes]]] = {}
        for raw in self._reader.raw_messages([topic for topic in self._reader.topics() if topic in topics]):
            entry = raw.log_time_ns, raw.publish_time_ns, raw.sequence, raw.data
            found.setdefault(raw.topic, []).append(entry)
        for topic in list(found):
            block = Block.of(found.pop(topic))
            self._blocks.append(block)
            yield len(self._blocks) - 1, {topic: block}

    def message(self, place: Place) -> bytes:
        """As `BagIndex.message`."""
        return self._blocks[place.chunk].content[place.start : place.start + place.size]
