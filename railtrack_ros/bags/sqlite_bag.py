"""Recordings that are not plain MCAP: SQLite files, and folders compressed by file or message."""

from __future__ import annotations

import array
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader

from railtrack_ros.bags.mcap_file import FACTS, RawMessage, Topic, Wanted
from railtrack_ros.errors import InputError

SQLITE_MAGIC = b'SQLite format 3\0'
MARK = b'\xff\xfe\xfdcut\xfa\xf9'
LARGEST = 1 << 40  # bytes that a header may tell and be believed
LATEST = (1 << 63) - 1  # ns, of what SQLite can hold


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

    def messages(self, wanted: Wanted) -> Iterator[RawMessage]:
        """Yield the messages that are wanted in the order of their log time."""
        chosen = [x for x in self._reader.connections
                  if wanted.topics is None or x.topic in wanted.topics]
        if not chosen:
            return
        since = max(wanted.since, 0)
        until = min(wanted.until, LATEST)
        last: int | None = None
        try:
            for connection, log_time, data in self._reader.messages(chosen, since, until):
                last = log_time
                yield RawMessage(connection.topic, connection.msgtype, log_time, bytes(data))
        except GeneratorExit:
            raise
        except Exception as error:
            if last is None:
                raise InputError(f'{self.path}: is damaged ({error})') from error
            note = (f'{self.path}: is damaged: read up to {(last - self.start_time) / 1e9:.3f} s, '
                    f'the last {max(0, self.end_time - last) / 1e9:.3f} s left out ({error})')
            if note not in self.notes:
                self.notes.append(note)

    def close(self) -> None:
        """Close the files."""
        if self._reader.is_open:
            self._reader.close()


def told_size(path: Path) -> int:
    """Return the size of a SQLite file in bytes as its header tells it, 0 where that cannot be."""
    with path.open('rb') as file:
        head = file.read(32)
    page = int.from_bytes(head[16:18], 'big')
    size = (65536 if page == 1 else page) * int.from_bytes(head[28:32], 'big')
    return size if size < LARGEST else 0


def is_cut(path: Path) -> bool:
    """Tell whether a SQLite file is shorter than its header tells."""
    return path.stat().st_size < told_size(path)


class SalvagedSqlite:
    """A `.db3` file that was cut off: its messages up to the first page that is missing.

    SQLite refuses a file that is shorter than its header says. So a copy of it is filled up with
    a mark, and read in the order of writing until the mark shows. The last message of each topic
    before that is left out too, for its end may be the mark's first bytes.

    Attributes
    ----------
    topics, start_time, end_time, metadata, notes
        As those of :class:`~railtrack_ros.bags.mcap_file.McapFile`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self._folder = tempfile.TemporaryDirectory(prefix='railtrack_salvage_')
        try:
            self._database = self._filled_up(Path(self._folder.name) / path.name)
            rows = self._database.execute('SELECT id, name, type, serialization_format FROM topics')
            self._topics = {
                number: Topic(str(name), str(kind), str(encoding), 0)
                for number, name, kind, encoding in rows}
            times, counts = array.array('q'), Counter[int]()
            self._left_out: set[int] = set()
            last: dict[int, int] = {}
            for number, topic, time, _ in self._rows():
                counts[topic] += 1
                times.append(time)
                last[topic] = number
            self._left_out.update(last.values())
            counts -= Counter(last.keys())
        except (sqlite3.Error, OSError, TypeError, OverflowError, ValueError) as error:
            self._folder.cleanup()
            raise InputError(f'{path}: cannot be read ({error})') from error
        self.topics = [replace(x, count=counts[number]) for number, x in self._topics.items()]
        self.start_time, self.end_time = min(times, default=0), max(times, default=0)
        self.notes = [f'{path}: not a finished recording (cut off): read up to '
                      f'{(self.end_time - self.start_time) / 1e9:.3f} s, what came after is lost']

    def messages(self, wanted: Wanted) -> Iterator[RawMessage]:
        """Yield the messages that are wanted in the order of writing."""
        for _, number, time, data in self._rows():
            topic = self._topics.get(number)
            if (topic is not None and wanted.since <= time < wanted.until
                    and (wanted.topics is None or topic.name in wanted.topics)):
                yield RawMessage(topic.name, topic.type, time, bytes(data))

    def close(self) -> None:
        """Close and remove the copy."""
        self._database.close()
        self._folder.cleanup()

    def _filled_up(self, copy: Path) -> sqlite3.Connection:
        shutil.copyfile(self.path, copy)
        with copy.open('r+b') as file:
            file.seek(0, 2)
            missing = told_size(self.path) - file.tell()
            while missing > 0:
                missing -= file.write((MARK * (1 << 16))[:missing])
        return sqlite3.connect(f'{copy.as_uri()}?mode=ro&immutable=1', uri=True)

    def _rows(self) -> Iterator[tuple[Any, ...]]:
        """Yield id, topic, log time and data in the order of writing, to where the file ends."""
        query = 'SELECT id, topic_id, timestamp, data FROM messages ORDER BY id'
        try:
            for row in self._database.execute(query):
                if None in row or not isinstance(row[3], bytes) or MARK in row[3]:
                    return
                if row[0] not in self._left_out:
                    yield row
        except sqlite3.DatabaseError:
            return
