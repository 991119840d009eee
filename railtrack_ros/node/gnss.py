"""GNSS fixes beside the track positions: a table for maps, and a check of the speed."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.bags import codec
from railtrack_ros.errors import InputError

NAVSATFIX = 'sensor_msgs/msg/NavSatFix'
SECOND = codec.SECOND

COLUMNS = ('time_s', 'position_m', 'speed_m_s', 'latitude_deg', 'longitude_deg', 'altitude_m')

EARTH_RADIUS = 6_371_008.8  # m, mean

# Time over which the positions are remembered [s], in so many steps a second.
MEMORY = 30.0
STEP = SECOND // 20
# Shortest way and time between two fixes from which a speed is told [m], [s]: a fix may be a few
# metres off.
LEAST_WAY = 50.0
LEAST_TIME = 3.0


def decode_fix(message: Any) -> tuple[int, float, float, float]:
    """Return stamp [ns], latitude, longitude [deg] and altitude [m, may be NaN] of a NavSatFix.

    Raises
    ------
    InputError
        The receiver has no fix, or the place is none on Earth.
    """
    if int(message.status.status) < 0:
        raise InputError('status: the receiver has no fix')
    latitude, longitude = float(message.latitude), float(message.longitude)
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        raise InputError(f'latitude, longitude: {latitude}, {longitude}, expected degrees')
    return codec.decode_stamp(message), latitude, longitude, float(message.altitude)


class Locations:
    """Pairs fixes with track positions.

    Parameters
    ----------
    table
        CSV file that gets a line for each fix, in the columns `COLUMNS`; None: no file.

    Attributes
    ----------
    fixes, paired
        Number of fixes, and of those whose track position is known.
    speed, odometer_speed
        From the last fixes and from the track positions over the same time [m/s], NaN: not known.

    Raises
    ------
    InputError
        The table cannot be written.
    """

    def __init__(self, table: Path | None = None) -> None:
        self.fixes = self.paired = 0
        self.speed = self.odometer_speed = math.nan
        self._positions: deque[tuple[int, float]] = deque(maxlen=round(MEMORY * SECOND / STEP))
        self._waiting: deque[tuple[int, float, float, float]] = deque(maxlen=1000)
        self._base: tuple[int, float, float, float] | None = None
        self._table = None
        if table is not None:
            try:
                fresh = not table.exists() or table.stat().st_size == 0
                self._table = table.open('a', encoding='utf-8', buffering=1)
                if fresh:
                    self._table.write(','.join(COLUMNS) + '\n')
            except OSError as error:
                raise InputError(f'parameter gnss_table: {table}: {error.strerror}') from None

    def close(self) -> None:
        """Close the table."""
        if self._table is not None:
            self._table.close()
            self._table = None

    def add_fix(self, stamp_ns: int, latitude: float, longitude: float, altitude: float) -> None:
        """Take a fix; it is paired as soon as the position at its stamp is known."""
        self.fixes += 1
        self._waiting.append((stamp_ns, latitude, longitude, altitude))

    def add_positions(self, stamp_ns: int, t: NDArray[np.float64],
                      position: NDArray[np.float64]) -> None:
        """Take the track positions (n,) [m] at t (n,) [s] after a stamp [ns]."""
        end_ns, place = stamp_ns + round(float(t[-1]) * SECOND), float(position[-1])
        if math.isnan(place) or (self._positions and end_ns < self._positions[-1][0]):
            self._positions.clear()
            self._base = None
            return
        if not self._positions or end_ns - self._positions[-1][0] >= STEP:
            self._positions.append((end_ns, place))
        while self._waiting and self._waiting[0][0] <= self._positions[-1][0]:
            self._pair(*self._waiting.popleft())

    def _pair(self, stamp_ns: int, latitude: float, longitude: float, altitude: float) -> None:
        if stamp_ns < self._positions[0][0]:
            return
        first = self._positions[0][0]
        times = [time_ns - first for time_ns, _ in self._positions]
        places = [place for _, place in self._positions]
        position = float(np.interp(stamp_ns - first, times, places))
        self.paired += 1
        self._compare(stamp_ns, position, latitude, longitude)
        if self._table is not None:
            numbers = (f'{position:.3f}', _text(self.odometer_speed, 3), f'{latitude:.8f}',
                       f'{longitude:.8f}', _text(altitude, 3))
            self._table.write(f'{stamp_ns / SECOND:.6f},' + ','.join(numbers) + '\n')

    def _compare(self, stamp_ns: int, position: float, latitude: float, longitude: float) -> None:
        """Tell the speeds since the last base point, which moves up once they are told."""
        if self._base is None:
            self._base = (stamp_ns, position, latitude, longitude)
            return
        seconds = (stamp_ns - self._base[0]) / SECOND
        if seconds < LEAST_TIME:
            return
        way = distance(self._base[2], self._base[3], latitude, longitude)
        run = abs(position - self._base[1])
        if max(way, run) >= LEAST_WAY:
            self.speed, self.odometer_speed = way / seconds, run / seconds
            self._base = (stamp_ns, position, latitude, longitude)

    @property
    def difference(self) -> float:
        """Share by which the two speeds differ, NaN where one is not known."""
        return abs(self.speed - self.odometer_speed) / max(self.speed, self.odometer_speed, 1e-9)


def distance(latitude: float, longitude: float, other_latitude: float, other_longitude: float
             ) -> float:
    """Great-circle distance [m] of two places [deg], by the haversine formula on a sphere."""
    a, b = math.radians(latitude), math.radians(other_latitude)
    half = math.radians(other_longitude - longitude) / 2.0
    h = math.sin((b - a) / 2.0)**2 + math.cos(a) * math.cos(b) * math.sin(half)**2
    return 2.0 * EARTH_RADIUS * math.asin(min(math.sqrt(h), 1.0))


def _text(value: float, digits: int) -> str:
    return '' if math.isnan(value) else f'{value:.{digits}f}'
