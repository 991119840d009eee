"""Whether an accelerometer measures up as down: its irregularity is then turned over.

The wheels of a rail roll over the same irregularity one after the other. Long waves in it come
from the twice integrated acceleration, so that a sensor wired the wrong way round finds the
negative of what the others find at the same place.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

GRID = 0.25  # m, length over which the irregularity is averaged
CLOSEST = 0.2  # share of it between two averages, at the least
MEMORY = 100.0  # m, which is compared
LEAST = 20.0  # m that two axle boxes must have in common


class Polarity:
    """Compares the irregularities that the axle boxes of a rail find at the same place."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._offsets = {box.name: box.offset for box in vehicle.axle_boxes}
        self._rails = [[box.name for box in vehicle.on_rail(rail)] for rail in vehicle.rails]
        length = max(self._offsets.values()) - min(self._offsets.values())
        self._positions: deque[float] = deque(maxlen=math.ceil((MEMORY + length) / GRID))
        self._values: deque[Array] = deque(maxlen=self._positions.maxlen)

    def block(self, position: Array, irregularity: Mapping[str, Array]) -> None:
        """Take the positions (n,) of a block and the irregularity (n,) by axle box."""
        travel = float(position[-1] - position[0])
        if not abs(travel) > 0.0:
            return
        if self._positions:
            since = float(position[0]) - self._positions[-1]
            if since * travel < 0.0 or abs(since) > MEMORY:
                self.forget()  # turned back, or set to another place
            elif abs(since) < CLOSEST * GRID:
                return
        pieces = min(max(round(abs(travel) / GRID), 1), position.size)
        size = position.size // pieces
        used = slice(0, size * pieces)
        places = position[used].reshape(pieces, size).mean(axis=1)
        values = np.array([irregularity[name] for name in self._offsets])
        means = values[:, used].reshape(len(values), pieces, size).mean(axis=2)
        self._positions.extend(places.tolist())
        self._values.extend(means.T)

    def forget(self) -> None:
        """Begin anew."""
        self._positions.clear()
        self._values.clear()

    def correlations(self) -> dict[str, float]:
        """Return, by axle box, its median correlation with the others on its rail.

        Between -1 and 1; NaN where too little of the track has been under both.
        """
        names = list(self._offsets)
        position = np.array(self._positions)
        if position.size < LEAST / GRID:
            return dict.fromkeys(names, math.nan)
        sign = 1.0 if position[-1] > position[0] else -1.0
        position *= sign  # rises now
        if np.any(np.diff(position) <= 0.0):
            return dict.fromkeys(names, math.nan)
        values = dict(zip(names, np.array(self._values).T, strict=True))
        places = {name: position + sign * self._offsets[name] for name in names}
        found = dict.fromkeys(names, math.nan)
        for rail in self._rails:
            for name in rail:
                others = [
                    _correlation(places[name], values[name], places[other], values[other])
                    for other in rail if other != name
                ]
                known = [value for value in others if not math.isnan(value)]
                found[name] = float(np.median(known)) if known else math.nan
        return found

    def reversed(self, limit: float) -> dict[str, float]:
        """Return the axle boxes that seem to be wired the wrong way round, and their correlation.

        Of two that contradict each other both are named: it takes a third one to tell which.
        """
        found = self.correlations()
        return {name: value for name, value in found.items() if value < -limit}


def _correlation(place: Array, value: Array, other_place: Array, other_value: Array) -> float:
    """Correlation coefficient over the stretch that both have been on."""
    inside = (place >= other_place[0]) & (place <= other_place[-1])
    a, b = value[inside], np.interp(place[inside], other_place, other_value)
    good = np.isfinite(a) & np.isfinite(b)
    if np.count_nonzero(good) * GRID < LEAST:
        return math.nan
    a, b = a[good] - a[good].mean(), b[good] - b[good].mean()
    scale = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / scale if scale > 0.0 else math.nan
