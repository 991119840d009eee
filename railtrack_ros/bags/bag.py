"""Any recording, opened for reading: rosbag2 folders, bare MCAP or SQLite files, also damaged."""

from __future__ import annotations

import heapq
import itertools
import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import yaml

from railtrack_ros.bags.codec import WAVEFORM, WaveformBlock
from railtrack_ros.bags.mcap_file import FACTS, MAGIC, McapFile, RawMessage, Topic, Wanted
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.sqlite_bag import SQLITE_MAGIC, RosbagsStorage, SalvagedSqlite, is_cut
from railtrack_ros.bags.waveform_cdr import WaveformReader
from railtrack_ros.errors import InputError

ROS1_MAGIC = b'#ROSBAG'


class Storage(Protocol):
    """One file of a recording, or a folder that is read as one."""

    start_time: int
    end_time: int
    notes: list[str]
    metadata: dict[str, dict[str, str]]

    @property
    def topics(self) -> Sequence[Topic]:
        """Return the topics; one may occur more than once."""

    def messages(self, wanted: Wanted) -> Iterator[RawMessage]:
        """Yield the messages that are wanted, as far as possible in the order of log time."""

    def close(self) -> None:
        """Close what is open."""


class NoTopic(InputError):
    """There is no topic of the type, or none of the name, that was looked for."""


class Bag:
    """A recording open for reading; use it in a `with` statement, or close it.

    Attributes
    ----------
    path
        The recording, the first one if there are several.
    topics
        Topics by name, with type, encoding and number of messages.
    start_time, end_time
        Log times [ns] of the first and the last message.
    facts
        What the recording says of the run beside its messages, such as `start_position`.
    """

    def __init__(self, path: Path, storages: list[Storage], notes: list[str]) -> None:
        self.path = path
        self._storages = storages
        self._waveforms: defaultdict[str, WaveformReader] = defaultdict(WaveformReader)
        self._notes = notes
        self.topics: dict[str, Topic] = {}
        for topic in itertools.chain.from_iterable(storage.topics for storage in storages):
            known = self.topics.get(topic.name, replace(topic, count=0))
            self.topics[topic.name] = replace(known, count=known.count + topic.count)
        filled = [storage for storage in storages if any(x.count for x in storage.topics)]
        if not filled:
            self.close()
            notes = [note.removeprefix(f'{path}: ').removeprefix(f'{path}{os.sep}')
                     for note in self.notes]
            raise InputError('; '.join([f'{path}: holds no messages', *notes]))
        self.start_time = min(storage.start_time for storage in filled)
        self.end_time = max(storage.end_time for storage in filled)
        self._storages.sort(key=lambda storage: storage.start_time)
        self.facts: dict[str, str] = {}
        for storage in reversed(self._storages):
            self.facts.update(storage.metadata.get(FACTS, {}))

    @property
    def notes(self) -> list[str]:
        """Return what could not be read so far, one line each; reading may add to it."""
        return [*self._notes, *itertools.chain.from_iterable(x.notes for x in self._storages)]

    @property
    def message_count(self) -> int:
        """Return the number of messages of all topics."""
        return sum(topic.count for topic in self.topics.values())

    def messages(
        self,
        topics: Collection[str] | None = None,
        since: int | None = None,
        until: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield the messages of some topics (None: of all) in the order of their log time.

        Only those with since <= log time < until [ns] come. Only a few chunks of the files are in
        memory at a time; files are merged where they overlap in time.
        """
        wanted = Wanted(topics, Wanted().since if since is None else since,
                        Wanted().until if until is None else until)
        waiting = [storage for storage in self._storages if any(x.count for x in storage.topics)]
        reading: list[tuple[int, int, RawMessage, Iterator[RawMessage]]] = []
        for number in range(len(waiting)):
            begin = waiting[number].start_time
            yield from self._earliest(reading, begin)
            stream = waiting[number].messages(wanted)
            self._next(reading, number, stream)
        yield from self._earliest(reading, None)

    @staticmethod
    def _next(
        reading: list[tuple[int, int, RawMessage, Iterator[RawMessage]]],
        number: int,
        stream: Iterator[RawMessage],
    ) -> None:
        """Put the next message of a stream among those that wait their turn."""
        message = next(stream, None)
        if message is not None:
            heapq.heappush(reading, (message.log_time, number, message, stream))

    def _earliest(
        self,
        reading: list[tuple[int, int, RawMessage, Iterator[RawMessage]]],
        before: int | None,
    ) -> Iterator[RawMessage]:
        """Yield the messages that were logged before a time (None: all), the earliest first."""
        while reading and (before is None or reading[0][0] < before):
            _, number, message, stream = heapq.heappop(reading)
            yield message
            self._next(reading, number, stream)

    def decode(self, message: RawMessage) -> Any:
        """Return a message as an object with the attributes of its type.

        Raises
        ------
        InputError
            The bytes are not a message of that type, or the type is not a common one.
        """
        self._check_encoding(message)
        if not OFFLINE.knows(message.type):
            raise InputError(f'{message.topic}: unknown message type {message.type!r}')
        try:
            return OFFLINE.deserialize(message.data, message.type)
        except InputError as error:
            raise InputError(f'{message.topic}: {error}') from error

    def waveform(self, message: RawMessage) -> WaveformBlock:
        """Return the samples of a message of a waveform topic.

        Raises
        ------
        InputError
            The message is no waveform (:func:`~railtrack_ros.bags.codec.decode_waveform`).
        """
        self._check_encoding(message)
        if message.type != WAVEFORM:
            raise InputError(f'{message.topic}: is a {message.type}, expected {WAVEFORM}')
        try:
            return self._waveforms[message.topic].read(message.data)
        except InputError as error:
            raise InputError(f'{message.topic}: {error}') from error

    def _check_encoding(self, message: RawMessage) -> None:
        encoding = self.topics[message.topic].encoding
        if encoding != 'cdr':
            raise InputError(f'{message.topic}: is encoded as {encoding!r}, expected cdr')

    def topic(self, wanted: str | None, usual: str, types: Collection[str], content: str) -> str:
        """Return the topic to read: the wanted one, the usual one, or the only one of its type.

        Parameters
        ----------
        wanted
            Name that was asked for, or None.
        usual
            Name to prefer if nothing was asked for.
        types
            Message types that can hold the content.
        content
            What is looked for, for messages.

        Raises
        ------
        InputError
            There is no such topic or more than one; the message lists what there is.
        """
        candidates = [topic.name for topic in self.topics.values() if topic.type in types]
        listed = ', '.join(f'{x.name} ({x.type})' for x in self.topics.values()) or 'none'
        for name in (wanted, usual):
            if name is None:
                continue
            name = name if name.startswith('/') else f'/{name}'
            if name in candidates:
                return name
            if name in self.topics:
                raise InputError(
                    f'{self.path}: {name} is a {self.topics[name].type}, '
                    f'expected {" or ".join(types)} for the {content}'
                )
            if wanted is not None:
                raise NoTopic(f'{self.path}: no topic {name}; there are: {listed}')
        measured = [name for name in candidates if not _is_result(name)]
        if len(measured) == 1:
            return measured[0]
        if measured:
            raise InputError(
                f'{self.path}: the {content} may be any of {", ".join(measured)}; say which'
            )
        raise NoTopic(
            f'{self.path}: no topic with the {content} ({" or ".join(types)}); there are: {listed}'
        )

    def close(self) -> None:
        """Close the files."""
        for storage in self._storages:
            storage.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def _is_result(topic: str) -> bool:
    """Return whether a waveform topic holds truth or results rather than a measurement."""
    results = ('contact_force', 'rail_deflection', 'irregularity')
    return topic.startswith('/truth/') or topic.rsplit('/', 1)[-1] in results


Paths = str | Path | Sequence[str | Path]


def paths_of(bag: Paths) -> list[Path]:
    """Return one path or several as a list; InputError for none, or the same one twice."""
    paths = [Path(bag)] if isinstance(bag, (str, Path)) else [Path(path) for path in bag]
    if not paths:
        raise InputError('name a recording')
    for number, path in enumerate(paths):
        if path.resolve() in [other.resolve() for other in paths[:number]]:
            raise InputError(f'{path}: is named twice')
    return paths


def open_bag(bag: Paths) -> Bag:
    """Open a recording, or several that are read as one.

    Parameters
    ----------
    bag
        A rosbag2 folder (MCAP or SQLite, split or compressed, also without `metadata.yaml`), or a
        single `.mcap` or `.db3` file. What kind of file it is shows in its first bytes. Several
        of them, in any order, are one run: messages come by their log time, and a time between
        them is a gap.

    Raises
    ------
    InputError
        There is nothing there, it is no recording, it holds no messages, or nothing of it can
        be read.
    """
    notes: list[str] = []
    storages: list[Storage] = []
    paths = paths_of(bag)
    try:
        for path in paths:
            if not path.exists():
                raise InputError(f'{path}: no such file or folder')
            storages += _open_folder(path, notes) if path.is_dir() else [_open_file(path)]
    except BaseException:
        for storage in storages:
            storage.close()
        raise
    return Bag(paths[0], storages, notes)


def _open_file(path: Path) -> Storage:
    """Open one file of a recording by what its first bytes say it is."""
    try:
        with path.open('rb') as file:
            head = file.read(16)
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({error.strerror})') from error
    if head.startswith(MAGIC):
        return McapFile(path)
    if head == SQLITE_MAGIC:
        return SalvagedSqlite(path) if is_cut(path) else RosbagsStorage(path)
    if not head:
        raise InputError(f'{path}: is empty')
    if head.startswith(ROS1_MAGIC):
        raise InputError(f'{path}: is a ROS 1 bag; convert it with rosbags-convert first')
    raise InputError(f'{path}: is not a recording (expected MCAP or a rosbag2 folder)')


def _open_folder(path: Path, notes: list[str]) -> list[Storage]:
    """Open all files of a rosbag2 folder in the order of the recording."""
    listing = path / 'metadata.yaml'
    if not listing.exists():
        files = sorted([*path.glob('*.mcap'), *path.glob('*.db3')], key=_natural)
        if not files:
            raise InputError(f'{path}: is not a recording (no metadata.yaml, .mcap or .db3 in it)')
        notes.append(f'{path}: no metadata.yaml, the recording was not closed')
        return [_open_file(file) for file in files]
    try:
        information = yaml.safe_load(listing.read_bytes())['rosbag2_bagfile_information']
        names = [Path(name).name for name in information['relative_file_paths']]
        compressed = information.get('compression_mode') or information.get('compression_format')
        storage = information['storage_identifier']
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError) as error:
        reason = ' '.join(str(error).split())
        raise InputError(f'{listing}: is not the metadata of a recording ({reason})') from error
    missing = [name for name in names if not (path / name).is_file()]
    if missing or not names:
        raise InputError(f'{path}: {", ".join(missing) or "no file"} of metadata.yaml is missing')
    cut = storage == 'sqlite3' and any(is_cut(path / name) for name in names)
    if not compressed and (storage == 'mcap' or cut):
        return [_open_file(path / name) for name in names]
    return [RosbagsStorage(path)]


def _natural(path: Path) -> list[int | str]:
    """Sort key which puts run_10 behind run_9."""
    parts = re.split(r'(\d+)', path.name)
    return [int(part) if part.isdigit() else part for part in parts]
