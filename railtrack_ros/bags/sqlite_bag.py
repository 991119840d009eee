"""Recordings that are not plain MCAP: SQLite files, and folders compressed by file or message."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader

from railtrack_ros.bags.mcap_file import FACTS, RawMessage, Topic
from railtrack_ros.errors import InputError

SQLITE_MAGIC = b'SQLite format 3\0'


class RosbagsStorage:
    """A recording read by the library rosbags, which takes all of it or nothing.

    Parameters
    ----------
    path
        A rosbag2 folder with `metadata.yaml`, or a `.db3` file.

    Attributes
    ----------
    topics, start_time, end_time, metadata, notes
        As those of :class:`~railtrack_ros.bags.mcap_file.McapFile`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        try:
            self._reader = Reader(path)
            self._reader.open()
        except Exception as error:  # rosbags, its YAML, its SQLite and zstd each have their own
            raise InputError(f'{path}: cannot be read ({error})') from error
        filled = self._reader.message_count > 0
        self.start_time = self._reader.start_time if filled else 0
        self.end_time = self._reader.end_time - 1 if filled else 0
        custom = self._reader.storage.metadata.custom
        self.metadata = {FACTS: dict(custom)} if custom else {}
        self.topics = []
        for connection in self._reader.connections:
            extension = connection.ext
            encoding = 'cdr'
            if isinstance(extension, ConnectionExtRosbag2):
                encoding = extension.serialization_format
            self.topics.append(
                Topic(connection.topic, connection.msgtype, encoding, connection.msgcount)
            )

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of some topics (None: of all) in the order of their log time."""
        wanted = [x for x in self._reader.connections if topics is None or x.topic in topics]
        if not wanted:
            return
        try:
            for connection, log_time, data in self._reader.messages(wanted):
                yield RawMessage(connection.topic, connection.msgtype, log_time, bytes(data))
        except GeneratorExit:
            raise
        except Exception as error:
            raise InputError(f'{self.path}: is damaged ({error})') from error

    def close(self) -> None:
        """Close the files."""
        if self._reader.is_open:
            self._reader.close()
