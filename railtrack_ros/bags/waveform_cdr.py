"""Waveforms between arrays and the bytes of their messages, for recordings of millions of them.

Messages of a topic differ in stamp and samples alone. So what stands around these is taken from the
first message, which goes through the message classes, and serves for those that are laid out like
it; a message that differs goes through the message classes again. The bytes and the samples
are the same either way.
"""

from __future__ import annotations

import functools
import struct
from typing import NamedTuple

import numpy as np

from railtrack_ros.bags.codec import (
    WAVEFORM,
    WaveformBlock,
    block_of,
    decode_waveform,
    encode_waveform,
    is_dense,
    points_of,
    split_stamp,
    waveform_layout,
)
from railtrack_ros.bags.message_types import OFFLINE

LITTLE_ENDIAN = b'\x00\x01\x00\x00'  # what CDR of the usual kind begins with
STAMP = struct.Struct('<iI')
BEGIN, AFTER_STAMP = len(LITTLE_ENDIAN), len(LITTLE_ENDIAN) + STAMP.size


class _Like(NamedTuple):
    """What a message has in common with those like it: all between stamp and samples, and size."""

    between: bytes
    size: int
    layout: np.dtype
    samples: int
    frame_id: str


class WaveformReader:
    """Reads the waveforms of a topic, one after the other, from their CDR bytes."""

    def __init__(self) -> None:
        self._like: _Like | None = None

    def read(self, data: bytes) -> WaveformBlock:
        """Return what a message says; InputError where it is no waveform."""
        like = self._like
        if like is not None and len(data) == like.size and data[:BEGIN] == LITTLE_ENDIAN:
            start = AFTER_STAMP + len(like.between)
            if data[AFTER_STAMP:start] == like.between:
                seconds, nanoseconds = STAMP.unpack_from(data, BEGIN)
                points = np.frombuffer(data, like.layout, like.samples, start)
                return block_of(points, seconds, nanoseconds, like.frame_id)
        message = OFFLINE.deserialize(data, WAVEFORM)
        block = decode_waveform(message)
        self._like = None
        octets = message.data.tobytes()
        start = len(data) - 1 - len(octets)
        if data[:BEGIN] == LITTLE_ENDIAN and data[start:-1] == octets and data[
                start - 4:start] == len(octets).to_bytes(4, 'little'):
            self._like = _Like(data[AFTER_STAMP:start], len(data), waveform_layout(message),
                               block.samples, block.frame_id)
        return block


def waveform_bytes(block: WaveformBlock) -> bytes:
    """Return the CDR bytes of the message of a block."""
    points = points_of(block)
    between = _between(tuple(block.channels), block.position is not None, block.samples,
                       block.frame_id)
    dense = is_dense(points, len(block.channels))
    return b''.join((LITTLE_ENDIAN, STAMP.pack(*split_stamp(block.stamp_ns)), between,
                     points.data.cast('B'), b'\x01' if dense else b'\x00'))


@functools.lru_cache(maxsize=64)
def _between(names: tuple[str, ...], tracked: bool, samples: int, frame_id: str) -> bytes:
    """Return what stands between stamp and samples."""
    nothing = np.zeros(samples)
    block = WaveformBlock(0, nothing, dict.fromkeys(names, nothing), nothing if tracked else None,
                          frame_id)
    message = encode_waveform(block, OFFLINE)
    data = OFFLINE.serialize(message)
    return data[AFTER_STAMP:len(data) - 1 - message.row_step]
