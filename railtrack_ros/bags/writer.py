"""Recordings out: MCAP that any tool of the ROS 2 world opens.

A path that ends in `.mcap` becomes a single file, any other a rosbag2 folder with
`metadata.yaml` and one MCAP file named as `ros2 bag reindex` expects. Files are of profile
ros2, in zstd-compressed chunks with index and checksums, and carry the message definitions.
"""

from __future__ import annotations

import contextlib
import copy
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import yaml
from mcap.writer import Writer

from railtrack_ros import __version__
from railtrack_ros.bags.codec import SECOND, WAVEFORM, WaveformBlock, encode_speed
from railtrack_ros.bags.joining import join_files
from railtrack_ros.bags.mcap_file import FACTS, FACTS_CHECKSUM, facts_checksum
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.waveform_cdr import waveform_bytes
from railtrack_ros.errors import InputError
from railtrack_ros.output import refuse_inputs, replacing

ACCELERATION_TOPIC = '/axle_box_acceleration'
SPEED_TOPIC = '/speed'
FRAME = 'base_link'

METADATA_VERSION = 9
LIBRARY = f'railtrack_ros {__version__}'

Topics = Mapping[tuple[str, str], int]  # number of messages by topic and type


class Recording:
    """A recording that is being written, to be used in a `with` statement.

    It appears under its name only when it is complete: an error or an interrupt inside the `with`
    leaves nothing behind. With `survive` it is written under its own name from the start and
    handed to the operating system at least once per second of log time, so that after a
    kill everything up to the last second can be read; an error inside the `with` then still
    closes it properly.

    Parameters
    ----------
    path
        Where to: `NAME.mcap` for a single file, which replaces one that was there, else a rosbag2
        folder, which must not be there yet or be empty.
    survive
        Write for a live run that may be killed.
    inputs
        Recordings that are being read meanwhile, which must not be written over.

    Attributes
    ----------
    start_time, end_time
        Earliest and latest log time so far [ns].
    facts
        What was written by :meth:`write_facts`.
    """

    def __init__(
        self, path: str | Path, *, survive: bool = False, inputs: Iterable[str | Path] = ()
    ) -> None:
        self.path = Path(path)
        self.survive = survive
        self.start_time = 2**63 - 1
        self.end_time = 0
        self.facts: dict[str, str] = {}
        self._folder = self.path.suffix != '.mcap'
        self._counts: Counter[tuple[str, str]] = Counter()
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._flushed = 0
        refuse_inputs(path, inputs)
        self._replacing = contextlib.ExitStack()
        try:
            self._file = self._create()
        except OSError as error:
            raise self._cannot(error) from error
        self._writer = Writer(self._file)
        self._writer.start('ros2', LIBRARY)

    # Writing

    def declare(self, topics: Mapping[str, str]) -> None:
        """Open topics (name to type) in this order; messages may follow or not.

        Recordings that declare the same topics first can be joined.
        """
        for topic, type_name in topics.items():
            key = (topic, type_name)
            if key not in self._channels:
                self._open_channel(key)

    def write_raw(self, topic: str, type_name: str, log_time: int, data: bytes) -> None:
        """Write a message given as CDR bytes.

        Parameters
        ----------
        topic
            Full name, with the leading slash.
        type_name
            Such as 'sensor_msgs/msg/PointCloud2'.
        log_time
            When it was received, nanoseconds since the epoch.
        data
            CDR bytes with their four bytes of encapsulation, as rclpy and recordings give them.
        """
        if not 0 <= log_time < 2**63:
            raise InputError(f'{self.path}: {topic}: log time {log_time} ns is out of range')
        key = (topic, type_name)
        try:
            channel = self._channels.get(key) or self._open_channel(key)
            self._writer.add_message(channel, log_time, data, log_time, self._counts[key])
            self._counts[key] += 1
            self.start_time = min(self.start_time, log_time)
            self.end_time = max(self.end_time, log_time)
            if self.survive and abs(log_time - self._flushed) >= SECOND:
                self._flushed = log_time
                self._writer.flush()
        except OSError as error:
            raise self._cannot(error) from error

    def write(self, topic: str, message: Any, log_time: int) -> None:
        """Write a message made of the classes for recordings (`message_types.OFFLINE`)."""
        self.write_raw(topic, message.__msgtype__, log_time, OFFLINE.serialize(message))

    def write_waveform(self, topic: str, block: WaveformBlock, log_time: int | None = None) -> None:
        """Write a waveform, logged at its last sample if nothing else is said."""
        time = block.end_ns if log_time is None else log_time
        self.write_raw(topic, WAVEFORM, time, waveform_bytes(block))

    def write_speed(
        self, stamp_ns: int, speed: float, topic: str = SPEED_TOPIC, frame_id: str = FRAME
    ) -> None:
        """Write a speed [m/s], logged at its stamp."""
        self.write(topic, encode_speed(stamp_ns, speed, frame_id, OFFLINE), stamp_ns)

    def write_facts(self, facts: Mapping[str, Any]) -> None:
        """Write facts about the run, such as `start_position` in metres, to be read with it.

        Numbers are written so that they are read back exactly.
        """
        self.facts.update({key: str(value) for key, value in facts.items()})
        try:
            checksum = {FACTS_CHECKSUM: facts_checksum(self.facts)}
            self._writer.add_metadata(FACTS, {**self.facts, **checksum})
        except OSError as error:
            raise self._cannot(error) from error

    @property
    def messages(self) -> int:
        """Return the number of messages written so far."""
        return sum(self._counts.values())

    # Opening and closing

    def close(self) -> None:
        """Finish the recording and give it its name; nothing happens the second time."""
        if self._file.closed:
            return
        try:
            with self._replacing:
                self._writer.finish()
                self._file.close()
                if self._folder:
                    extent = (self.start_time, self.end_time)
                    write_metadata(
                        self._place, self._file_name, self._counts, extent, self.facts)
        except OSError as error:
            raise self._cannot(error) from error

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None or self.survive:
            self.close()
        else:
            self._file.close()
            self._replacing.__exit__(kind, error, traceback)

    def _create(self) -> BinaryIO:
        """Create the file, and the folder around it, that is written to."""
        if not self.survive:
            self._place = self._replacing.enter_context(replacing(self.path))
        else:
            self._place = self.path
            self._place.parent.mkdir(parents=True, exist_ok=True)
            if self._folder and self._place.is_dir() and any(self._place.iterdir()):
                raise InputError(f'{self.path}: is a folder that is not empty; name another')
        if not self._folder:
            return self._place.open('wb')
        self._place.mkdir(exist_ok=True)
        return (self._place / self._file_name).open('wb')

    @property
    def _file_name(self) -> str:
        return name_in_folder(self.path)

    def _open_channel(self, key: tuple[str, str]) -> int:
        """Register topic and type, with the definition of the type where it is known."""
        topic, name = key
        known = OFFLINE.knows(name)
        if name not in self._schemas:
            definition = OFFLINE.definition(name).encode() if known else b''
            encoding = 'ros2msg' if known else ''
            self._schemas[name] = self._writer.register_schema(name, encoding, definition)
        metadata = {'offered_qos_profiles': '[]'}
        if known:
            metadata['topic_type_hash'] = OFFLINE.type_hash(name)
        channel = self._writer.register_channel(topic, 'cdr', self._schemas[name], metadata)
        self._channels[key] = channel
        return channel

    def _cannot(self, error: OSError) -> InputError:
        return InputError(f'{self.path}: cannot be written ({error.strerror or error})')


def join_recordings(
    parts: Sequence[Path],
    topics: Mapping[str, str],
    output: str | Path,
    facts: Mapping[str, Any],
    inputs: Iterable[str | Path] = (),
) -> None:
    """Join recordings of the same topics into one, in this order and without unpacking them.

    Parameters
    ----------
    parts
        Finished `.mcap` files that all declared `topics`, as :meth:`Recording.declare` does; the
        first one holds the facts.
    topics
        Types of the topics by name.
    output, inputs
        As for :class:`Recording`.
    facts
        Facts for `metadata.yaml`.
    """
    refuse_inputs(output, inputs)
    folder = Path(output).suffix != '.mcap'
    try:
        with replacing(output) as place:
            if folder:
                place.mkdir()
            name = name_in_folder(Path(output))
            found = join_files(parts, place / name if folder else place, LIBRARY)
            if folder:
                counts = {
                    key: found.channel_message_counts.get(number, 0)
                    for number, key in enumerate(topics.items(), 1)
                }
                extent = (found.message_start_time, found.message_end_time)
                write_metadata(place, name, counts, extent, facts)
    except OSError as error:
        raise InputError(f'{output}: cannot be written ({error.strerror or error})') from error


def name_in_folder(folder: Path) -> str:
    """Return the name of the file in a rosbag2 folder."""
    return f'{folder.resolve().name}_0.mcap'


def write_metadata(
    folder: Path, file: str, topics: Topics, extent: tuple[int, int], facts: Mapping[str, Any]
) -> None:
    """Write the `metadata.yaml` of a folder with one file.

    Parameters
    ----------
    extent
        Log times of the first and the last message [ns]; any where there is no message.
    """
    count = sum(topics.values())
    start, end = extent if count else (0, 0)
    span = {
        'starting_time': {'nanoseconds_since_epoch': start},
        'duration': {'nanoseconds': end - start},
        'message_count': count,
    }
    content = {
        'rosbag2_bagfile_information': {
            'version': METADATA_VERSION,
            'storage_identifier': 'mcap',
            **span,
            'topics_with_message_count': [
                {
                    'topic_metadata': {
                        'name': topic,
                        'type': name,
                        'serialization_format': 'cdr',
                        'offered_qos_profiles': [],
                        'type_description_hash':
                            OFFLINE.type_hash(name) if OFFLINE.knows(name) else '',
                    },
                    'message_count': number,
                }
                for (topic, name), number in topics.items()
                if number
            ],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [file],
            'files': [{'path': file, **copy.deepcopy(span)}],
            'custom_data': {key: str(value) for key, value in facts.items()} or None,
            'ros_distro': 'jazzy',
        }
    }
    text = yaml.safe_dump(content, sort_keys=False)
    (folder / 'metadata.yaml').write_text(text, encoding='utf-8')
