"""MCAP out: messages in zstd chunks with index and checksums, and files joined chunk by chunk.

Messages come by the thousand a second, so a message costs no more here than to append it to the
chunk under way. The records other than messages and chunks are those of the library mcap.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.summary import Summary

from railtrack_ros.bags.mcap_file import MAGIC

CHUNK_SIZE = 1 << 20
# Half the time of the usual level 3, and files of samples 5 % larger.
COMPRESSION, LEVEL = 'zstd', 1
FOOTER_LENGTH = 20

# Record head; channel, sequence, log time, publication time of a message.
MESSAGE = struct.Struct('<BQHIQQ')
MESSAGE_LENGTH = MESSAGE.size - 9
# Record head; start time, end time, size, checksum, name of the compression, compressed size.
CHUNK = struct.Struct(f'<BQQQQII{len(COMPRESSION)}sQ')
INDEX = struct.Struct('<BQHI')
ENTRY = 16  # bytes in the index of a message: log time and offset in the chunk


class Writer:
    """An MCAP file that grows by whole chunks.

    Parameters
    ----------
    file
        Open for writing in binary; closed by whoever has opened it.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: Counter[int] = Counter()
        self._content = bytearray()
        self._index: dict[int, list[int]] = {}  # by channel: log time, offset, log time, ...
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)

    def start(self, profile: str, library: str) -> None:
        """Begin the file."""
        self._file.write(MAGIC)
        self._add(Header(profile, library))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a message type; returns its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas[schema.id] = schema
        self._content += _bytes(schema)
        return schema.id

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: Mapping[str, str]
    ) -> int:
        """Add a topic; returns its number."""
        channel = Channel(id=len(self._channels) + 1, topic=topic, schema_id=schema_id,
                          message_encoding=message_encoding, metadata=dict(metadata))
        self._channels[channel.id] = channel
        self._content += _bytes(channel)
        return channel.id

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int
    ) -> None:
        """Add a message, times in nanoseconds."""
        content = self._content
        self._index.setdefault(channel_id, []).extend((log_time, len(content)))
        content += MESSAGE.pack(Opcode.MESSAGE, MESSAGE_LENGTH + len(data), channel_id,
                                sequence & 0xFFFFFFFF, log_time, publish_time)
        content += data
        if len(content) > CHUNK_SIZE:
            self._end_chunk()

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record."""
        offset = self._file.tell()
        length = self._add(Metadata(name=name, metadata=dict(data)))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def flush(self) -> None:
        """Finish the chunk under way and hand everything to the operating system."""
        self._end_chunk()
        self._file.flush()

    def copy_chunks(self, source: BinaryIO, summary: Summary) -> None:
        """Copy the chunks of another file with their message indexes, as they are.

        Raises
        ------
        ValueError
            A number stands for another topic there.
        """
        assert summary.statistics is not None
        for number, channel in summary.channels.items():
            if self._channels.setdefault(number, channel).topic != channel.topic:
                raise ValueError(f'{channel.topic} and {self._channels[number].topic} are both '
                                 f'channel {number}: declare the same topics in all parts')
        self._schemas.update(summary.schemas)
        self._counts.update(summary.statistics.channel_message_counts)
        for old in summary.chunk_indexes:
            shift = self._file.tell() - old.chunk_start_offset
            source.seek(old.chunk_start_offset)
            left = old.chunk_length + old.message_index_length
            while left > 0:
                piece = source.read(min(left, 1 << 20))
                if not piece:
                    raise EOFError('the part ends within a chunk')
                left -= self._file.write(piece)
            self._chunks.append(ChunkIndex(
                chunk_length=old.chunk_length,
                chunk_start_offset=old.chunk_start_offset + shift,
                compression=old.compression,
                compressed_size=old.compressed_size,
                message_end_time=old.message_end_time,
                message_index_length=old.message_index_length,
                message_index_offsets={
                    number: at + shift for number, at in old.message_index_offsets.items()},
                message_start_time=old.message_start_time,
                uncompressed_size=old.uncompressed_size,
            ))

    def statistics(self) -> Statistics:
        """Return the statistics of all finished chunks."""
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((x.message_end_time for x in self._chunks), default=0),
            message_start_time=min((x.message_start_time for x in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        self._end_chunk()
        self._add(DataEnd(data_section_crc=0))
        start = self._file.tell()
        summary = RecordBuilder()
        offsets = []
        for opcode, records in self._groups():
            begin = summary.count
            for record in records:
                record.write(summary)
            if records:
                offsets.append(SummaryOffset(group_opcode=opcode, group_start=start + begin,
                                             group_length=summary.count - begin))
        offset_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        head = struct.pack('<BQQQ', Opcode.FOOTER, FOOTER_LENGTH, start, offset_start)
        footer = Footer(summary_start=start, summary_offset_start=offset_start,
                        summary_crc=zlib.crc32(head, zlib.crc32(data)))
        self._file.write(data + _bytes(footer) + MAGIC)

    def _groups(self) -> Iterator[tuple[Opcode, Sequence[Schema | Channel | Statistics
                                                         | ChunkIndex | MetadataIndex]]]:
        """Yield what the summary is made of."""
        yield Opcode.SCHEMA, list(self._schemas.values())
        yield Opcode.CHANNEL, list(self._channels.values())
        yield Opcode.STATISTICS, [self.statistics()]
        yield Opcode.CHUNK_INDEX, self._chunks
        yield Opcode.METADATA_INDEX, self._metadata

    def _add(self, record: Header | Metadata | DataEnd) -> int:
        """Write a record that stands outside of chunks; returns its length."""
        return self._file.write(_bytes(record))

    def _end_chunk(self) -> None:
        """Write the chunk under way with the index of its messages, if it has any."""
        if not self._index:
            return
        content, index = self._content, self._index
        self._content, self._index = bytearray(), {}
        first = min(min(entries[::2]) for entries in index.values())
        last = max(max(entries[::2]) for entries in index.values())
        data = self._compressor.compress(content)
        offset = self._file.tell()
        length = CHUNK.size + len(data)
        self._file.write(CHUNK.pack(
            Opcode.CHUNK, length - 9, first, last, len(content), zlib.crc32(content),
            len(COMPRESSION), COMPRESSION.encode(), len(data)))
        self._file.write(data)
        there, written = {}, 0
        for channel, entries in index.items():
            there[channel] = offset + length + written
            size = ENTRY * (len(entries) // 2)
            written += self._file.write(
                INDEX.pack(Opcode.MESSAGE_INDEX, INDEX.size - 9 + size, channel, size)
                + struct.pack(f'<{len(entries)}Q', *entries))
            self._counts[channel] += len(entries) // 2
        self._chunks.append(ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=COMPRESSION,
            compressed_size=len(data),
            message_end_time=last,
            message_index_length=written,
            message_index_offsets=there,
            message_start_time=first,
            uncompressed_size=len(content),
        ))


def _bytes(record: Schema | Channel | Header | Metadata | DataEnd | Footer) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def join_files(parts: Sequence[Path], output: Path, library: str) -> Statistics:
    """Write the chunks of several MCAP files, one after the other, as one indexed file.

    Nothing is unpacked.

    Parameters
    ----------
    parts
        Finished MCAP files in which equal numbers of channels and schemas mean the same, as those
        of recordings that declare the same topics. Metadata records come from the first one.
    output, library
        The file to write, and what its header names as its maker.

    Returns
    -------
    Statistics
        Those of the joined file.

    Raises
    ------
    ValueError
        A number means different topics in two of the parts.
    OSError
        A part cannot be read, or the output not be written.
    """
    with output.open('wb') as file:
        joined = Writer(file)
        joined.start('ros2', library)
        for number, part in enumerate(parts):
            with part.open('rb') as source:
                reader = SeekingReader(source)
                summary = reader.get_summary()
                assert summary is not None
                if number == 0:
                    for record in reader.iter_metadata():
                        joined.add_metadata(record.name, record.metadata)
                joined.copy_chunks(source, summary)
        joined.finish()
        return joined.statistics()
