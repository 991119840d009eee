"""How the columns of a measurement of another system are to be understood."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from railtrack_ros.errors import InputError

ACCELERATION_UNITS = {'m/s2': 1.0, 'g': 9.80665}
POSITION_UNITS = {'m': 1.0, 'km': 1000.0}
SPEED_UNITS = {'m/s': 1.0, 'km/h': 1.0 / 3.6}

NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')
RESERVED = ('t', 'position')


@dataclass(frozen=True)
class Calibration:
    """How a channel's numbers become acceleration: (number - offset) / sensitivity, then the unit.

    Attributes
    ----------
    sensitivity
        Number in the file per unit of acceleration; negative for a sensor that is mounted
        upside down, as `inverted` is.
    offset
        Number in the file at rest.
    inverted
        Whether down is positive in the file.
    """

    sensitivity: float = 1.0
    offset: float = 0.0
    inverted: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sensitivity) and self.sensitivity != 0.0):
            raise InputError(f'--sensitivity {self.sensitivity:g}: expected a number but 0')
        if not math.isfinite(self.offset):
            raise InputError(f'--offset {self.offset:g}: expected a finite number')

    @property
    def factor(self) -> float:
        """Return what the number, less its offset, is multiplied by."""
        return (-1.0 if self.inverted else 1.0) / self.sensitivity


@dataclass(frozen=True)
class HighPass:
    """A sensor chain's high-pass to be undone: corner [Hz], order, and down to which frequency."""

    frequency: float
    order: int = 1
    lowest: float = 0.0

    @classmethod
    def parse(cls, text: str) -> HighPass:
        """Read HZ, HZ:ORDER or HZ:ORDER:LOWEST; LOWEST is a tenth of HZ unless given."""
        parts = text.split(':')
        try:
            if len(parts) > 3:
                raise ValueError
            frequency = float(parts[0])
            order = int(parts[1]) if len(parts) > 1 else 1
            lowest = float(parts[2]) if len(parts) > 2 else 0.1 * frequency
        except ValueError:
            raise InputError(f'--undo-high-pass {text}: expected HZ[:ORDER[:LOWEST_HZ]], '
                             'for example 0.5:1') from None
        if not (0.0 < lowest < frequency < math.inf and 1 <= order <= 4):
            raise InputError(f'--undo-high-pass {text}: expected HZ above LOWEST_HZ above 0, '
                             'and an order from 1 to 4')
        return cls(frequency, order, lowest)

    def __str__(self) -> str:
        return f'{self.frequency:g}:{self.order}:{self.lowest:g}'


@dataclass(frozen=True)
class ImportSettings:
    """How the columns of a file are to be understood.

    Attributes
    ----------
    channels
        Column of the file to name of the axle box.
    acceleration_unit
        'm/s2' or 'g'.
    calibration
        Of channels by their name; the others hold acceleration as it is.
    undo_high_pass
        The high-pass of the sensor chain that is undone, if any.
    decimate
        One of so many samples is kept, after an anti-aliasing filter.
    sample_rate
        Samples per second, where neither of the next two is given and the file does not tell.
    time_column
        Column of the time [s].
    position_column, position_unit
        Column of the track position, in 'm' or 'km', increasing.
    speed_column, speed, speed_unit
        Column of the speed, or one value for the whole file; 'm/s' or 'km/h'.
    """

    channels: Mapping[str, str]
    acceleration_unit: str = 'm/s2'
    sample_rate: float | None = None
    time_column: str | None = None
    position_column: str | None = None
    position_unit: str = 'm'
    speed_column: str | None = None
    speed: float | None = None
    speed_unit: str = 'm/s'
    calibration: Mapping[str, Calibration] = field(default_factory=dict)
    undo_high_pass: HighPass | None = None
    decimate: int = 1

    def __post_init__(self) -> None:
        bases = (self.sample_rate, self.time_column, self.position_column)
        if sum(base is not None for base in bases) > 1:
            raise InputError('give one of --sample-rate, --time-column, --position-column')
        if self.decimate < 1:
            raise InputError(f'--decimate {self.decimate}: expected a whole number of at least 1')
        for name in self.calibration:
            if name not in self.channels.values():
                raise InputError(f'{name}: no such channel to calibrate; they are: '
                                 f'{", ".join(self.channels.values())}')
        if (self.speed_column is None) == (self.speed is None):
            raise InputError('give one of --speed-column, --speed: no estimate without a speed')
        for option, unit, known in (
            ('--acceleration-unit', self.acceleration_unit, ACCELERATION_UNITS),
            ('--position-unit', self.position_unit, POSITION_UNITS),
            ('--speed-unit', self.speed_unit, SPEED_UNITS),
        ):
            if unit not in known:
                raise InputError(f'{option} {unit}: expected {" or ".join(known)}')


def facts_of(settings: ImportSettings) -> dict[str, Any]:
    """Return what was done to the samples, for the record."""
    facts: dict[str, Any] = {'acceleration_unit': settings.acceleration_unit}
    for name, calibration in settings.calibration.items():
        facts[f'calibration {name}'] = (
            f'sensitivity {calibration.sensitivity!r}, offset {calibration.offset!r}'
            + (', inverted' if calibration.inverted else ''))
    if settings.undo_high_pass is not None:
        facts['undone high-pass'] = settings.undo_high_pass
    if settings.decimate > 1:
        facts['decimated by'] = settings.decimate
    return facts


def parse_channels(text: str) -> dict[str, str]:
    """Return column to channel name from 'a,b' or 'column=name,...'.

    Raises
    ------
    InputError
        A name that cannot be part of a topic name, or a column or name given twice.
    """
    channels: dict[str, str] = {}
    for part in text.split(','):
        column, _, name = part.rpartition('=')
        column, name = (column or name).strip(), name.strip()
        if not NAME.fullmatch(name) or name in RESERVED:
            raise InputError(
                f'--channels: {name!r} cannot name a channel (letters, digits and _, beginning '
                f'with a letter, not {" or ".join(RESERVED)}); give COLUMN=NAME'
            )
        if column in channels or name in channels.values():
            raise InputError(f'--channels: {part.strip()!r}: column or name given twice')
        channels[column] = name
    return channels


def parse_calibration(
    channels: Collection[str], sensitivity: str | None, offset: str | None, invert: str | None
) -> dict[str, Calibration]:
    """Return the calibration of channels from the words of three options.

    Parameters
    ----------
    channels
        Names of all channels.
    sensitivity, offset
        'NUMBER' for all channels, or 'NAME=NUMBER,NAME=NUMBER'.
    invert
        'NAME,NAME', or 'all'.

    Raises
    ------
    InputError
        A name that is no channel, or something that is no number.
    """
    factors = _by_channel('--sensitivity', sensitivity, channels)
    offsets = _by_channel('--offset', offset, channels)
    inverted = set(channels) if invert == 'all' else {
        name.strip() for name in (invert or '').split(',') if name.strip()}
    for name in inverted - set(channels):
        raise InputError(f'--invert: no channel {name!r}; they are: {", ".join(channels)}')
    return {
        name: Calibration(factors.get(name, 1.0), offsets.get(name, 0.0), name in inverted)
        for name in channels if name in factors or name in offsets or name in inverted}


def _by_channel(option: str, text: str | None, channels: Collection[str]) -> dict[str, float]:
    """Return numbers by channel from 'NUMBER' or 'NAME=NUMBER,...'."""
    found: dict[str, float] = {}
    for part in (text or '').split(',') if text else []:
        name, given, number = part.rpartition('=')
        try:
            value = float(number)
        except ValueError:
            raise InputError(f'{option} {part.strip()}: expected NUMBER, or NAME=NUMBER,...'
                             ) from None
        if given and name.strip() not in channels:
            raise InputError(f'{option}: no channel {name.strip()!r}; they are: '
                             f'{", ".join(channels)}')
        found.update({name.strip(): value} if given else dict.fromkeys(channels, value))
    return found
