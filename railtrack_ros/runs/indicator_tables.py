"""Tables of indicators as CSV, Parquet or GeoJSON, and where their positions are on Earth."""

from __future__ import annotations

import csv
import importlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.errors import InputError
from railtrack_ros.irregularity.profile import read_columns, reason
from railtrack_ros.output import replacing, write_csv

Array = NDArray[np.float64]
Row = Mapping[str, str | float | int | None]

FORMATS = ('.csv', '.parquet', '.geojson')

# Digits of what has been measured; places are written as they are.
DIGITS = 6
PLACES = ('from_m', 'to_m', 'length_m', 'block_m', 'longitude_deg', 'latitude_deg')


@dataclass(frozen=True)
class Geography:
    """Places on Earth: longitude and latitude (n,) [deg] by increasing position (n,) [m]."""

    position: Array
    longitude: Array
    latitude: Array

    def at(self, position: float) -> tuple[float, float]:
        """Return longitude and latitude [deg] at a track position [m], nearest beyond the ends."""
        return (float(np.interp(position, self.position, self.longitude)),
                float(np.interp(position, self.position, self.latitude)))

    def line(self, start: float, end: float) -> list[list[float]]:
        """Return the points (longitude, latitude) of the track between two positions [m]."""
        inside = self.position[(self.position > start) & (self.position < end)]
        return [[round(c, 8) for c in self.at(x)] for x in (start, *inside.tolist(), end)]


class Places:
    """Brings satellite fixes and track positions of a recording together by their stamps."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._positions: list[float] = []
        self._fixes: list[tuple[int, float, float]] = []

    def add_position(self, stamp_ns: int, position: float) -> None:
        """Take the track position [m] of the vehicle's reference point at a stamp."""
        if math.isfinite(position):
            self._stamps.append(stamp_ns)
            self._positions.append(position)

    def add_fix(self, message: Any) -> None:
        """Take a `sensor_msgs/msg/NavSatFix`; one without a fix says nothing."""
        fix = (float(message.longitude), float(message.latitude))
        if message.status.status >= 0 and all(map(math.isfinite, fix)):
            stamp = message.header.stamp
            self._fixes.append((stamp.sec * 1_000_000_000 + stamp.nanosec, *fix))

    def geography(self) -> Geography | None:
        """Return the places by position, None without two of them."""
        if not self._stamps:
            return None
        first, last = min(self._stamps), max(self._stamps)
        order = np.argsort(self._stamps, kind='stable')
        stamps = (np.array(self._stamps)[order] - first) * 1e-9
        positions = np.array(self._positions)[order]
        points = {}
        for stamp, longitude, latitude in self._fixes:
            if first <= stamp <= last:
                place = float(np.interp((stamp - first) * 1e-9, stamps, positions))
                points[place] = (longitude, latitude)
        if len(points) < 2:
            return None
        position = np.array(sorted(points))
        longitude, latitude = np.array([points[x] for x in position]).T
        return Geography(position, longitude, latitude)


def read_geography(path: str | Path) -> Geography:
    """Read a CSV file with the columns position_m, longitude_deg and latitude_deg.

    Raises
    ------
    InputError
        No such file, a column is missing, a value is no number, or positions do not increase.
    """
    path, names = Path(path), ['position_m', 'longitude_deg', 'latitude_deg']
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            header = [name.strip() for name in next(csv.reader(file), [])]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'geography {path}: cannot be read: {reason(error)}') from error
    for name in names:
        if name not in header:
            raise InputError(f'geography {path}: line 1: column {name} is missing, expected '
                             f'{", ".join(names)}')
    position, longitude, latitude = read_columns(path, header, names, 'geography').T
    if not (np.diff(position) > 0.0).all():
        raise InputError(f'geography {path}: column position_m has to increase')
    if np.abs(longitude).max() > 180.0 or np.abs(latitude).max() > 90.0:
        raise InputError(f'geography {path}: longitude or latitude is beyond 180 or 90 degrees')
    return Geography(position, longitude, latitude)


def check_format(path: str | Path, geography: Geography | None = None,
                 known: bool = False) -> None:
    """Raise InputError for a table that cannot be written.

    known: whether it is known by now that there is no geography.
    """
    suffix = Path(path).suffix.lower()
    if suffix == '.parquet':
        load_parquet(path)
    elif suffix == '.geojson':
        if known and geography is None:
            raise InputError(
                f'{path}: GeoJSON needs places on Earth: the recording has no '
                'sensor_msgs/msg/NavSatFix with a fix; give --geography FILE.csv')
    elif suffix in ('.xlsx', '.json', '.html', '.mcap'):
        raise InputError(f'{path}: a table is written as {", ".join(FORMATS)}')


def write_table(path: str | Path, rows: Sequence[Row], geography: Geography | None = None,
                columns: Sequence[str] = (), exact: bool = False) -> None:
    """Write rows of equal keys as .parquet, .geojson, or else CSV; None is an empty field.

    Parameters
    ----------
    path
        Its ending chooses the format.
    rows
        With `from_m` and `to_m` for GeoJSON, where each is a line along the track.
    geography
        Where the track is, for GeoJSON.
    columns
        Names of the columns, needed where there are no rows.
    exact
        Whether numbers are written to the last digit, or in six digits but for places.

    Raises
    ------
    InputError
        GeoJSON without geography, or Parquet without pyarrow.
    """
    check_format(path, geography, known=True)
    if not exact:
        rows = [{name: _rounded(name, value) for name, value in row.items()} for row in rows]
    names = list(rows[0]) if rows else list(columns)
    table = {name: [row[name] for row in rows] for name in names}
    suffix = Path(path).suffix.lower()
    if suffix == '.parquet':
        arrow, parquet = load_parquet(path)
        with replacing(path) as place:
            parquet.write_table(arrow.table(table), place)
    elif suffix == '.geojson':
        assert geography is not None
        features = [_feature(row, geography) for row in rows]
        with replacing(path) as place:
            place.write_text(json.dumps({'type': 'FeatureCollection', 'features': features},
                                        allow_nan=False), encoding='utf-8')
    else:
        write_csv(path, table)


def _rounded(name: str, value: str | float | int | None) -> str | float | int | None:
    if not isinstance(value, float) or name in PLACES:
        return value
    return float(f'{value:.{DIGITS}g}')


def _feature(row: Row, geography: Geography) -> dict[str, Any]:
    start, end = row['from_m'], row['to_m']
    assert isinstance(start, (int, float))
    assert isinstance(end, (int, float))
    return {'type': 'Feature', 'properties': dict(row),
            'geometry': {'type': 'LineString', 'coordinates': geography.line(start, end)}}


def load_parquet(path: str | Path) -> tuple[Any, Any]:
    """Return the modules pyarrow and pyarrow.parquet; InputError without them."""
    try:
        pyarrow, parquet = map(importlib.import_module, ('pyarrow', 'pyarrow.parquet'))
    except ImportError as error:
        raise InputError(
            f'{path}: Parquet needs the package pyarrow: pip install pyarrow, or write .csv'
        ) from error
    return pyarrow, parquet
