"""One MCAP file: whatever of it is whole is read, and what is lost is said.

A finished file carries a summary with the place and the time span of every chunk. Where it is
missing or wrong, because the writer was killed, is still writing, or bytes were damaged,
the file is scanned from the start for whole chunks with a correct checksum. Messages then
come in the order of their log time with the memory of the few chunks that overlap.
"""

from __future__ import annotations

import heapq
import json
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.summary import Summary

from railtrack_ros.errors import InputError

MAGIC = b'\x89MCAP0\r\n'
# Facts about a run that no message carries stand in the metadata record of this name. Records
# outside of chunks have no checksum of their own, so the facts bring one along.
FACTS = 'railtrack'
FACTS_CHECKSUM = 'crc32'

FOOTER_SIZE = 9 + 20 + len(MAGIC)  # footer record with its checksum last, then the magic again
LARGEST_CHUNK = 1 << 30
RECORD = struct.Struct('<BQ')  # kind and length of a record
MESSAGE = struct.Struct('<H4xQ')  # channel and log time in the head of a message
MESSAGE_HEAD = 22
SPAN_SIZE = 1 << 20

# Damaged bytes end in many kinds of errors inside the decompressors and the record reader
# (McapError, struct.error, ZstdError, RuntimeError, UnicodeDecodeError, MemoryError, ...).
DAMAGE = Exception


@dataclass(frozen=True)
class Topic:
    """A topic of a recording."""

    name: str
    type: str
    encoding: str
    count: int


class RawMessage(NamedTuple):
    """A message as it was recorded: CDR bytes and the time [ns] when it was logged."""

    topic: str
    type: str
    log_time: int
    data: bytes


class Wanted(NamedTuple):
    """Messages of some topics (None: of all) with since <= log time < until [ns]."""

    topics: Collection[str] | None = None
    since: int = -1
    until: int = 1 << 64


class Span(NamedTuple):
    """Bytes of a file that hold messages: a chunk, or records that stand outside of chunks."""

    start_time: int
    offset: int
    end_time: int
    length: int
    chunked: bool


def type_name(schema: Schema | None) -> str:
    """Return the full name of a message type, also where a writer left '/msg/' out."""
    name = schema.name if schema else ''
    return name.replace('/', '/msg/') if name.count('/') == 1 else name


def facts_checksum(facts: Mapping[str, str]) -> str:
    """Return the checksum of facts, which stands among them as `FACTS_CHECKSUM`."""
    text = json.dumps({k: v for k, v in sorted(facts.items()) if k != FACTS_CHECKSUM})
    return f'{zlib.crc32(text.encode()):08x}'


def duration(nanoseconds: int) -> str:
    """Return a stretch of a recording in words; damaged bytes may tell any number."""
    seconds = nanoseconds / 1e9
    return f'{seconds:.3f} s' if 0.0 <= seconds < 86400.0 else 'a stretch of unknown length'


def _messages(data: bytes, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
    """Yield channel, log time and data of the messages of some channels among records."""
    at = 0
    while at < len(data):
        opcode, length = RECORD.unpack_from(data, at)
        begin, at = at + RECORD.size, at + RECORD.size + length
        if at > len(data):
            raise ValueError('a record is longer than what it stands in')
        if opcode == Opcode.MESSAGE:
            channel, time = MESSAGE.unpack_from(data, begin)
            if length < MESSAGE_HEAD:
                raise ValueError('a message is shorter than its head')
            if channel in channels:
                yield channel, time, data[begin + MESSAGE_HEAD:at]


class McapFile:
    """An MCAP file open for reading.

    Parameters
    ----------
    path
        The file: any compression, chunked or not, with or without summary, whole or cut off.

    Attributes
    ----------
    topics
        The topics that have a channel in the file, with the number of messages.
    start_time, end_time
        Log times [ns] of the first and the last message; both 0 for a file without any.
    metadata
        The key-value pairs of the metadata records, by the name of the record.
    notes
        What could not be read, in words. Reading adds to it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._spans: list[Span] = []
        self._lost: set[int] = set()
        try:
            self._file: BinaryIO = path.open('rb')
        except OSError as error:
            raise InputError(f'{path}: cannot be read ({error.strerror})') from error
        self._size = path.stat().st_size
        try:
            if not self._read_summary():
                self._scan()
        except BaseException:
            self.close()
            raise
        self.start_time = min((span.start_time for span in self._spans), default=0)
        self.end_time = max((span.end_time for span in self._spans), default=0)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def topics(self) -> list[Topic]:
        """Return the topics, one entry per channel."""
        return [
            Topic(
                channel.topic,
                type_name(self._schemas.get(channel.schema_id)),
                channel.message_encoding,
                self._counts[number],
            )
            for number, channel in self._channels.items()
        ]

    def messages(self, wanted: Wanted) -> Iterator[RawMessage]:
        """Yield the messages that are wanted in the order of their log time.

        Messages of equal log time come in the order in which they stand in the file. A chunk
        that turns out damaged is left out and told in `notes`; one without a wanted time is
        not read.
        """
        first, last = wanted.since, wanted.until
        channels = {
            number: (channel.topic, type_name(self._schemas.get(channel.schema_id)))
            for number, channel in self._channels.items()
            if wanted.topics is None or channel.topic in wanted.topics
        }
        waiting: list[tuple[int, int, int, RawMessage]] = []
        for span in sorted(x for x in self._spans if x.end_time >= first and x.start_time < last):
            while waiting and waiting[0][0] < span.start_time:
                yield heapq.heappop(waiting)[-1]
            for index, (channel, time, data) in enumerate(self._read(span, channels)):
                if first <= time < last:
                    message = RawMessage(*channels[channel], time, data)
                    heapq.heappush(waiting, (time, span.offset, index, message))
        while waiting:
            yield heapq.heappop(waiting)[-1]

    def _read(self, span: Span, channels: Collection[int]) -> list[tuple[int, int, bytes]]:
        """Return channel, log time and data of the messages of a span; none if it is damaged."""
        try:
            if span.chunked:
                stream, length = get_chunk_data_stream(self._chunk_here(span.offset), True)
                return list(_messages(stream.read(length), channels))
            self._file.seek(span.offset)
            return list(_messages(self._file.read(span.length), channels))
        except DAMAGE as error:
            self._lose(span.offset, span.start_time, span.end_time, str(error))
            return []

    def _chunk_here(self, offset: int) -> Chunk:
        """Return the chunk record that begins at an offset of the file."""
        self._file.seek(offset)
        stream = ReadDataStream(self._file)
        opcode, length = stream.read1(), stream.read8()
        if opcode != Opcode.CHUNK or offset + 9 + length > self._size:
            raise ValueError('no whole chunk where the index has one')
        chunk = Chunk.read(stream)
        if chunk.uncompressed_size > LARGEST_CHUNK:
            raise ValueError(f'chunk of {chunk.uncompressed_size} bytes')
        return chunk

    def _lose(self, offset: int, start_time: int, end_time: int, reason: str) -> None:
        """Note the loss of a span of the file, once."""
        if offset not in self._lost:
            self._lost.add(offset)
            self.notes.append(
                f'{self.path}: damaged at byte {offset}, '
                f'{duration(end_time - start_time)} left out ({reason})'
            )

    def _read_summary(self) -> bool:
        """Read the index at the end of the file; return whether it is there and can be used."""
        try:
            self._file.seek(0)
            reader = SeekingReader(self._file, record_size_limit=self._size)
            summary = reader.get_summary()
            if summary is None or not self._summary_is_sound(summary):
                return False
            if any(item.length > self._size for item in summary.metadata_indexes):
                return False
            if summary.metadata_indexes:
                for index, record in zip(
                    summary.metadata_indexes, reader.iter_metadata(), strict=True
                ):
                    if record.name != index.name:
                        return False
                    self._take_metadata(record)
        except DAMAGE:
            self.metadata.clear()
            return False
        assert summary.statistics is not None
        self._schemas, self._channels = summary.schemas, summary.channels
        self._counts.update(summary.statistics.channel_message_counts)
        self._spans = [
            Span(
                x.message_start_time,
                x.chunk_start_offset,
                x.message_end_time,
                x.chunk_length,
                True,
            )
            for x in summary.chunk_indexes
        ]
        return True

    def _take_metadata(self, record: Metadata) -> None:
        """Take a metadata record; facts with a wrong checksum are left out and told."""
        found = record.metadata
        if record.name == FACTS and found.get(FACTS_CHECKSUM, '') not in (
            '', facts_checksum(found)
        ):
            self.notes.append(f'{self.path}: the facts of the run (start position and others) are '
                              'damaged and left out')
            return
        self.metadata[record.name] = {k: v for k, v in found.items() if k != FACTS_CHECKSUM}

    def _summary_is_sound(self, summary: Summary) -> bool:
        """Return whether a summary is complete, undamaged and about this file."""
        statistics = summary.statistics
        if statistics is None or len(summary.chunk_indexes) != statistics.chunk_count:
            return False
        if statistics.message_count and not summary.chunk_indexes:
            return False  # messages outside of chunks are not indexed
        if any(number not in summary.channels for number in statistics.channel_message_counts):
            return False
        if any(
            channel.schema_id and channel.schema_id not in summary.schemas
            for channel in summary.channels.values()
        ):
            return False
        if any(
            chunk.chunk_start_offset + chunk.chunk_length > self._size
            for chunk in summary.chunk_indexes
        ):
            return False
        self._file.seek(self._size - FOOTER_SIZE + 9)
        start = int.from_bytes(self._file.read(8), 'little')
        self._file.seek(start)
        covered = self._file.read(self._size - start - len(MAGIC) - 4)
        checksum = int.from_bytes(self._file.read(4), 'little')
        return checksum in (0, zlib.crc32(covered))

    def _scan(self) -> None:
        """Find what is whole by going through the file from its start."""
        self._file.seek(0)
        records = StreamReader(self._file, emit_chunks=True, record_size_limit=self._size).records
        offset = len(MAGIC)
        loose: list[tuple[int, int]] = []
        try:
            for record in records:
                if isinstance(record, Chunk):
                    self._scan_chunk(record, offset)
                elif isinstance(record, Message):
                    self._counts[record.channel_id] += 1
                    loose.append((record.log_time, offset))
                    if offset - loose[0][1] > SPAN_SIZE:
                        self._add_loose(loose, self._file.tell())
                elif isinstance(record, Metadata):
                    self._take_metadata(record)
                else:
                    self._register(record)
                if not isinstance(record, Message):
                    self._add_loose(loose, offset)
                offset = self._file.tell()
        except DAMAGE:
            self._add_loose(loose, offset)
            self._note_cut(offset)

    def _scan_chunk(self, chunk: Chunk, offset: int) -> None:
        """Take a chunk into the index if it is whole."""
        try:
            if chunk.uncompressed_size > LARGEST_CHUNK:
                raise ValueError(f'chunk of {chunk.uncompressed_size} bytes')
            content = breakup_chunk(chunk, validate_crc=True)
        except DAMAGE as error:
            self._lose(offset, chunk.message_start_time, chunk.message_end_time, str(error))
            return
        times = [record.log_time for record in content if isinstance(record, Message)]
        for record in content:
            if isinstance(record, Message):
                self._counts[record.channel_id] += 1
            else:
                self._register(record)
        if times:
            length = self._file.tell() - offset
            self._spans.append(Span(min(times), offset, max(times), length, True))

    def _register(self, record: object) -> None:
        """Take a schema or a channel; the first one counts, which stands in a checked chunk."""
        if isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self._channels.setdefault(record.id, record)

    def _add_loose(self, loose: list[tuple[int, int]], end: int) -> None:
        """Take messages outside of chunks into the index, up to the byte `end`."""
        if loose:
            times = [time for time, _ in loose]
            start = loose[0][1]
            self._spans.append(Span(min(times), start, max(times), end - start, False))
            loose.clear()

    def _note_cut(self, offset: int) -> None:
        """Note what is lost after the last whole record, which ends at `offset`."""
        self._file.seek(offset)
        head = self._file.read(25)
        lost = ''
        if len(head) == 25 and head[0] == Opcode.CHUNK and self._spans:
            # The chunk that was being written begins with the times of its messages.
            end_time = int.from_bytes(head[17:25], 'little')
            lost = f', {duration(end_time - max(span.end_time for span in self._spans))}'
        self.notes.append(
            f'{self.path}: not a finished recording (cut off, damaged or still being written): '
            f'read up to byte {offset}, the last {self._size - offset} bytes left out{lost}'
        )
