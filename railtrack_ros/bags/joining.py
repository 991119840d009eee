"""Recordings of the same topics, made side by side, joined into one without unpacking them."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

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

FOOTER_LENGTH = 20


class _Output:
    """An MCAP file that grows by whole records."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkIndex] = []
        self.metadata: list[MetadataIndex] = []
        self.counts: Counter[int] = Counter()

    def add(self, record: Header | Metadata | DataEnd) -> int:
        """Write a record; returns its length."""
        builder = RecordBuilder()
        record.write(builder)
        return self.file.write(builder.end())

    def copy_chunks(self, source: BinaryIO, summary: Summary) -> None:
        """Copy the chunks of another file with their message indexes, as they are."""
        assert summary.statistics is not None
        for number, channel in summary.channels.items():
            if self.channels.setdefault(number, channel).topic != channel.topic:
                raise ValueError(f'{channel.topic} and {self.channels[number].topic} are both '
                                 f'channel {number}: declare the same topics in all parts')
        self.schemas.update(summary.schemas)
        self.counts.update(summary.statistics.channel_message_counts)
        for old in summary.chunk_indexes:
            shift = self.file.tell() - old.chunk_start_offset
            source.seek(old.chunk_start_offset)
            left = old.chunk_length + old.message_index_length
            while left > 0:
                piece = source.read(min(left, 1 << 20))
                if not piece:
                    raise EOFError('the part ends within a chunk')
                left -= self.file.write(piece)
            self.chunks.append(ChunkIndex(
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
        """Return the statistics of all parts together."""
        return Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            message_end_time=max((x.message_end_time for x in self.chunks), default=0),
            message_start_time=min((x.message_start_time for x in self.chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )

    def groups(self) -> Iterator[tuple[Opcode, Sequence[Schema | Channel | Statistics
                                                        | ChunkIndex | MetadataIndex]]]:
        """Yield what the summary is made of."""
        yield Opcode.SCHEMA, list(self.schemas.values())
        yield Opcode.CHANNEL, list(self.channels.values())
        yield Opcode.STATISTICS, [self.statistics()]
        yield Opcode.CHUNK_INDEX, self.chunks
        yield Opcode.METADATA_INDEX, self.metadata

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        self.add(DataEnd(data_section_crc=0))
        start = self.file.tell()
        summary = RecordBuilder()
        offsets = []
        for opcode, records in self.groups():
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
        head = (bytes([Opcode.FOOTER]) + FOOTER_LENGTH.to_bytes(8, 'little')
                + start.to_bytes(8, 'little') + offset_start.to_bytes(8, 'little'))
        footer = RecordBuilder()
        Footer(summary_start=start, summary_offset_start=offset_start,
               summary_crc=zlib.crc32(head, zlib.crc32(data))).write(footer)
        self.file.write(data + footer.end() + MAGIC)


def join_files(parts: Sequence[Path], output: Path, library: str) -> Statistics:
    """Write the chunks of several MCAP files, one after the other, as one indexed file.

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
        file.write(MAGIC)
        joined = _Output(file)
        joined.add(Header(profile='ros2', library=library))
        for number, part in enumerate(parts):
            with part.open('rb') as source:
                reader = SeekingReader(source)
                summary = reader.get_summary()
                assert summary is not None
                if number == 0:
                    for record in reader.iter_metadata():
                        offset = file.tell()
                        length = joined.add(record)
                        joined.metadata.append(
                            MetadataIndex(offset=offset, length=length, name=record.name))
                joined.copy_chunks(source, summary)
        joined.finish()
        return joined.statistics()
