"""Results of a recording along the track: waveforms by the axle boxes' own places, as they come."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from railtrack_ros.bags.bag import Bag
from railtrack_ros.bags.codec import WAVEFORM
from railtrack_ros.errors import InputError
from railtrack_ros.runs import configuration
from railtrack_ros.runs.comparison import pieces
from railtrack_ros.runs.results import CONFIGURATION, WAVEFORMS
from railtrack_ros.vehicle.description import AxleBox, Vehicle

Array = NDArray[np.float64]

# Who gives results, the usual one first.
SOURCES = ('/track_estimator', '/full_model', '/truth')
JUMP = 0.1      # m: samples further apart are not joined
FEWEST = 8      # samples of a piece


@dataclass(frozen=True)
class Source:
    """The results of one who gives them in a recording, with the axle boxes that they are of."""

    bag: Bag
    prefix: str
    quantities: tuple[str, ...]
    axle_boxes: tuple[AxleBox, ...]
    software: str = ''

    @property
    def topics(self) -> dict[str, str]:
        """Return the quantities by topic."""
        return {f'{self.prefix}/{quantity}': quantity for quantity in self.quantities}


def find_source(bag: Bag, prefix: str | None = None, vehicle: Vehicle | None = None) -> Source:
    """Return the results in a recording.

    Parameters
    ----------
    prefix
        Who gives them, such as '/full_model'; None: the usual one.
    vehicle
        Its axle boxes; None: as the recording tells.

    Raises
    ------
    InputError
        There are no such results, or it is not known where the axle boxes are.
    """
    there = [name.rsplit('/', 1) for name, topic in bag.topics.items()
             if topic.type == WAVEFORM and topic.count and name.rsplit('/', 1)[-1] in WAVEFORMS]
    prefixes = list(dict.fromkeys(first for first, _ in there))
    listed = ', '.join(prefixes) or 'none'
    if prefix is None:
        usual = [name for name in (*SOURCES, *prefixes) if name in prefixes]
        if not usual:
            raise InputError(f'{bag.path}: holds no results (contact_force, rail_deflection or '
                             'irregularity with positions); railtrack estimate makes some')
        prefix = usual[0]
    prefix = '/' + prefix.strip('/')
    quantities = tuple(q for q in WAVEFORMS if [prefix, q] in there)
    if not quantities:
        raise InputError(f'{bag.path}: no results of {prefix}; there are those of: {listed}')
    if vehicle is not None:
        return Source(bag, prefix, quantities, vehicle.axle_boxes)
    told = [name for name in (f'{prefix}/{CONFIGURATION}', *(f'{p}/{CONFIGURATION}'
                                                              for p in SOURCES))
            if name in bag.topics and bag.topics[name].type == configuration.TYPE]
    for message in bag.messages(set(told[:1])):
        text = bag.decode(message).data
        found = configuration.read_configuration(text, f'{bag.path}: {told[0]}')
        return Source(bag, prefix, quantities, found.axle_boxes)
    raise InputError(f'{bag.path}: does not tell where the axle boxes of {prefix} are; say it with '
                     '--vehicle')


class Curve:
    """Samples of one quantity of one axle box over its own place; between them splines."""

    def __init__(self) -> None:
        self._place: list[Array] = []
        self._values: list[Array] = []

    def add(self, place: Array, values: Array) -> None:
        """Take the samples (n,) of a block at places (n,) [m]."""
        self._place.append(place)
        self._values.append(values)

    def forget(self, before: float) -> None:
        """Drop what lies before a place [m]."""
        while self._place and not np.nanmax(self._place[0], initial=-math.inf) >= before:
            del self._place[0], self._values[0]

    def at(self, place: Array) -> Array:
        """Return the values (n,) at increasing places (n,), NaN where there are none."""
        result = np.full(place.size, np.nan)
        if not self._place:
            return result
        there, values = np.concatenate(self._place), np.concatenate(self._values)
        furthest = np.maximum.accumulate(np.where(np.isfinite(there), there, -np.inf))
        forward = np.append(True, there[1:] > furthest[:-1]) & np.isfinite(there)
        there, values = there[forward], values[forward]
        good = np.isfinite(values)
        good[1:] &= np.diff(there) < JUMP
        for begin, end in pieces(good):
            if end - begin < FEWEST:
                continue
            inside = slice(*np.searchsorted(place, [there[begin], there[end - 1]]))
            if inside.stop > inside.start:
                result[inside] = CubicSpline(there[begin:end], values[begin:end])(place[inside])
        return result


class ResultStream:
    """The results of a source, read as far along the track as is asked for.

    Attributes
    ----------
    curves
        By quantity and axle box: what is read and not yet forgotten.
    reached
        Place [m] that every axle box has passed.
    first
        Place [m] at which the first axle box begins.
    """

    def __init__(self, source: Source) -> None:
        self.curves = {q: {box.name: Curve() for box in source.axle_boxes}
                       for q in source.quantities}
        self.first, self.reached = math.inf, -math.inf
        self.fastest = self.time_step = 0.0
        self._source = source
        self._blocks = self._read()

    def begin(self) -> float:
        """Read until a place is known; returns `first`, infinity where there is none."""
        while not math.isfinite(self.first) and next(self._blocks, None) is not None:
            pass
        return self.first

    def read_to(self, place: float) -> bool:
        """Read on until all axle boxes have passed a place [m]; False at the end."""
        while self.reached < place:
            if next(self._blocks, None) is None:
                return False
        return True

    def forget(self, before: float) -> None:
        """Drop what lies before a place [m]."""
        for curves in self.curves.values():
            for curve in curves.values():
                curve.forget(before)

    def _read(self) -> Iterator[int]:
        """Read block by block."""
        source = self._source
        offsets = {box.name: box.offset for box in source.axle_boxes}
        topics, last = source.topics, source.quantities[-1]
        for message in source.bag.messages(set(topics)):
            try:
                block = source.bag.waveform(message)
            except InputError as error:
                raise InputError(f'{source.bag.path}: {error}') from error
            quantity = topics[message.topic]
            if block.position is None:
                raise InputError(f'{source.bag.path}: {message.topic}: has no field position')
            known = block.position[np.isfinite(block.position)]
            for name, curve in self.curves[quantity].items():
                if name in block.channels:
                    values = block.channels[name].astype(float)
                    curve.add(block.position + offsets[name], values)
            if known.size and quantity == last:
                self.first = min(self.first, float(known[0]) + min(offsets.values()))
                if known[-1] - known[0] < -JUMP:
                    raise InputError(f'{source.bag.path}: runs backwards, which cannot be compared')
                self.reached = max(self.reached, float(known[-1]) + min(offsets.values()))
                if block.samples > 1:
                    speed = (known[-1] - known[0]) / (known.size - 1) / block.time_step \
                        if known.size > 1 else 0.0
                    self.fastest = max(self.fastest, speed)
                    self.time_step = max(self.time_step, block.time_step)
            yield message.log_time
