"""Where message classes come from: the running ROS 2, or definitions that need no ROS at all.

The codec builds messages through one of these two, so that the same code serves the live node
and the recordings. The classes of both have the same names and fields; they differ in
what holds the bytes of a `uint8[]` field.
"""

from __future__ import annotations

import array
import functools
import importlib
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from railtrack_ros.errors import InputError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


class MessageTypes(Protocol):
    """A source of message classes, by full name such as 'sensor_msgs/msg/PointCloud2'."""

    def get(self, name: str) -> Any:
        """Return the class of a message type."""

    def octets(self, data: bytes) -> Any:
        """Return bytes in the form which these classes hold a `uint8[]` field in."""

    def __hash__(self) -> int:
        """Return a number by which what is made of these classes can be kept."""


class LiveTypes:
    """The message classes of the ROS 2 that is installed, for use with rclpy."""

    @functools.cache  # noqa: B019 (there is one object of this class)
    def get(self, name: str) -> Any:
        """Return the class of a message type; ImportError where ROS 2 is not at hand."""
        package, folder, message = name.split('/')
        return getattr(importlib.import_module(f'{package}.{folder}'), message)

    def octets(self, data: bytes) -> array.array[int]:
        """Return an array of unsigned bytes, which rclpy takes without looking at each."""
        return array.array('B', data)


class OfflineTypes:
    """The message classes of ROS 2 Jazzy as definitions alone, for recordings."""

    @functools.cached_property
    def store(self) -> Typestore:
        """Return the definitions of all common message types."""
        from rosbags.typesys import Stores, get_typestore

        return get_typestore(Stores.ROS2_JAZZY)

    def get(self, name: str) -> Any:
        """Return the class of a message type."""
        return self.store.types[name]

    def octets(self, data: bytes) -> np.ndarray:
        """Return an array of unsigned bytes that shares its memory with `data`."""
        return np.frombuffer(data, np.uint8)

    def knows(self, name: str) -> bool:
        """Return whether messages of this type can be read and written."""
        return name in self.store.types

    def serialize(self, message: Any) -> bytes:
        """Return the CDR bytes of a message made of these classes."""
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))

    def deserialize(self, data: bytes, name: str) -> Any:
        """Return the message in CDR bytes; InputError where they are not of that type."""
        try:
            return self.store.deserialize_cdr(data, name)
        except Exception as error:
            # Damaged bytes end in many kinds of errors (struct, index, memory, unicode).
            raise InputError(f'the bytes are not a {name} ({error})') from error

    def definition(self, name: str) -> str:
        """Return the definition of a type in the form that recordings carry ('ros2msg')."""
        return self.store.generate_msgdef(name, ros_version=2)[0]

    def type_hash(self, name: str) -> str:
        """Return the REP-2011 hash of a type."""
        return self.store.hash_rihs01(name)


LIVE = LiveTypes()
OFFLINE = OfflineTypes()
