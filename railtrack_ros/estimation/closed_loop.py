"""The test of the model itself: what one wheel measured must shake the wheels behind it.

The irregularity recovered at the leading wheel of a rail lies under the next wheel a moment later.
Driven forward over it, the model predicts the accelerations of the axle boxes behind; measured
minus predicted, per band of frequency, is the model residual. (The recovered irregularity lacks
long waves; the measured acceleration goes through the same high-pass before it is compared.)
It tells a wrong track (pads, sleepers), a wheel out of round or a faulty sensor, which no single
axle box can tell of itself.

A forward run costs more than the estimate, so it is done for LENGTH seconds in every PERIOD. When,
and what it gives, depends on the samples alone, not on the blocks.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.contact import longest_time_step
from railtrack_ros.dynamics.forward import StepFailure
from railtrack_ros.dynamics.modes import TrackModes
from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

BANDS = {'30-100 Hz': (30.0, 100.0), '100-400 Hz': (100.0, 400.0),
         '400-1000 Hz': (400.0, 1000.0), '1000-2000 Hz': (1000.0, 2000.0)}

PERIOD = 30.0  # s, from test to test
LENGTH = 1.0  # s, of a test
SETTLING = 0.25  # s of it, until the wheels have forgotten that they stood still

GRID = 0.001  # m, on which the irregularity waits for the wheels behind


@dataclass(frozen=True)
class Residual:
    """Root mean squares of an axle box's acceleration in a band [m/s2], of its last test.

    measured: of the acceleration; residual: of measured minus predicted.
    """

    measured: float
    residual: float

    @property
    def share(self) -> float:
        """Residual over measured; NaN where nothing was measured."""
        return self.residual / self.measured if self.measured > 0.0 else float('nan')


class ClosedLoop:
    """Tests the model on the wheels of one rail, or of two with wheels side by side.

    names (lines * wheels,): axle boxes, line by line; offsets (wheels,) [m]; time_step [s];
    cut_on_wavelength [m] of the irregularity; before: of an earlier stretch of the same wheels,
    whose results stand until there are new ones, and whose models serve again.
    """

    def __init__(self, modes: TrackModes, vehicle: Vehicle, names: tuple[str, ...],
                 offsets: Array, time_step: float, cut_on_wavelength: float,
                 before: ClosedLoop | None = None) -> None:
        self.names, self.offsets, self.time_step = names, offsets, time_step
        self._cut_on = cut_on_wavelength
        self._lines = len(names) // offsets.size
        self._bands = [signal.butter(2, band, 'bandpass', fs=1.0 / time_step, output='sos')
                       for band in BANDS.values() if band[1] < 0.4 / time_step]
        self._found: dict[str, dict[str, Residual]] = before.results() if before else {}
        self._length, self._settling = (round(x / time_step) for x in (LENGTH, SETTLING))
        # From the front to the back in the direction of travel.
        self._order = np.argsort(-offsets, kind='stable')
        cells = int(np.ptp(offsets) / GRID) + 8
        self._history = np.full((self._lines, cells), np.nan)
        self._distance = np.zeros(1)
        self._last: Array = np.full((self._lines, 2), np.nan)  # irregularity of the leading wheel
        self._direction = 1.0
        self._due, self._done = self._length, 0
        # What predicts, one model a line: costly to make, so a stretch leaves them to the next.
        # None where the samples are too far apart for a forward run: sensors of about 1 kHz.
        self._models: list[RecursiveForward] = []
        if before is not None and before.time_step == time_step:
            self._models = before._models
        elif offsets.size > 1 and time_step <= longest_time_step(vehicle):
            self._models = [RecursiveForward(modes, vehicle, offsets, time_step, 0.0, hold='linear')
                            for _ in range(self._lines)]
        self._testing = False
        self._high_pass: tuple[Array, Array] = np.zeros((2, 6)), np.zeros(0)  # sections, state
        self._filters: Array = np.zeros(0)
        self._power: Array = np.zeros(0)

    def results(self) -> dict[str, dict[str, Residual]]:
        """Residuals of the last test by axle box and band; none for leading wheels."""
        return copy.deepcopy(self._found)

    def add(self, place: Array, speed: Array, acceleration: Array, irregularity: Array) -> None:
        """Take the next samples.

        place (n,): of the reference point on the sleepers [m]; speed (n,) [m/s]; acceleration
        (n, lines * wheels) of the boxes, NaN where not measured; irregularity of the same shape.
        """
        if not self._models:
            return
        shape = (place.size, self._lines, self.offsets.size)
        acceleration, irregularity = acceleration.reshape(shape), irregularity.reshape(shape)
        turned = np.flatnonzero(speed * self._direction < 0.0)
        first = 0
        while turned.size:
            self._stretch(place[first:turned[0]], speed[first:turned[0]],
                          acceleration[first:turned[0]], irregularity[first:turned[0]])
            first = int(turned[0])
            self._turn()
            turned = first + np.flatnonzero(speed[first:] * self._direction < 0.0)
        self._stretch(place[first:], speed[first:], acceleration[first:], irregularity[first:])

    def _turn(self) -> None:
        """Travel in the other direction: another wheel leads."""
        self._direction = -self._direction
        self._order = self._order[::-1].copy()
        self._history[:] = self._last[:] = np.nan
        self._give_up()

    def _give_up(self) -> None:
        self._testing, self._due, self._done = False, self._length, 0

    def _stretch(self, place: Array, speed: Array, acceleration: Array, irregularity: Array
                 ) -> None:
        """Take samples of one direction of travel."""
        behind = np.abs(self.offsets[self._order] - self.offsets[self._order[0]])
        expected = np.empty_like(irregularity)
        _remember(np.abs(speed) * self.time_step, irregularity[:, :, self._order[0]], behind,
                  self._order, GRID, self._history, self._distance, self._last, expected)
        usable = np.asarray(np.isfinite(expected + acceleration).all(axis=(1, 2)))
        first = 0
        while first < place.size:
            if not self._testing:
                wait = min(self._due, place.size - first)
                self._due -= wait
                first += wait
                ready = np.flatnonzero(usable[first:])
                if self._due > 0 or ready.size == 0:
                    return
                first += int(ready[0])
                self._begin(float(place[first]), abs(float(speed[first])))
            end = min(first + self._length - self._done, place.size)
            broken = np.flatnonzero(~usable[first:end])
            end = first + int(broken[0]) if broken.size else end
            part = slice(first, end)
            try:
                if end > first:
                    self._test(place[part], acceleration[part], expected[part])
            except StepFailure:
                broken = np.zeros(1, int)
            first = end
            if broken.size:
                self._give_up()
            elif self._done == self._length:
                self._end()

    def _begin(self, place: float, speed: float) -> None:
        for model in self._models:
            model.restart(place)
        self._testing = True
        high_pass = signal.butter(4, speed / self._cut_on, 'highpass', fs=1.0 / self.time_step,
                                  output='sos')
        self._high_pass = high_pass, np.zeros((2, 2, self._lines, self.offsets.size))
        sections = self._bands[0].shape[0] if self._bands else 1
        shape = (len(self._bands), 2, self._lines, self.offsets.size)
        self._filters = np.zeros((*shape[:2], sections, 2, *shape[2:]))
        self._power = np.zeros(shape)
        self._done = 0

    def _test(self, place: Array, acceleration: Array, expected: Array) -> None:
        """Go on with a test: predict, filter, sum up sample after sample."""
        predicted = np.stack([
            forward.run(place, expected[:, n]).axle_box_acceleration
            for n, forward in enumerate(self._models)], axis=1)
        sections, memory = self._high_pass
        acceleration, memory = signal.sosfilt(sections, acceleration, axis=0, zi=memory)
        self._high_pass = sections, memory
        settled = np.arange(self._done, self._done + place.size) >= self._settling
        for b, band in enumerate(self._bands):
            for kind, x in enumerate((acceleration, acceleration - predicted)):
                y, self._filters[b, kind] = signal.sosfilt(
                    band, x, axis=0, zi=self._filters[b, kind])
                y[~settled] = 0.0
                self._power[b, kind] = np.add.accumulate(
                    np.concatenate((self._power[b, kind][None], y * y)))[-1]
        self._done += place.size

    def _end(self) -> None:
        """Keep the residuals of a test that is complete."""
        rms = np.sqrt(self._power / (self._length - self._settling))
        for n in range(self._lines):
            for w in self._order[1:]:
                self._found[self.names[n * self.offsets.size + w]] = {
                    name: Residual(float(rms[b, 0, n, w]), float(rms[b, 1, n, w]))
                    for b, name in enumerate(list(BANDS)[:len(self._bands)])}
        self._testing, self._done = False, 0
        self._due = round((PERIOD - LENGTH) / self.time_step)

    def state(self) -> dict[str, Any]:
        """A copy of what has to be remembered."""
        kept = {name: copy.deepcopy(value) for name, value in vars(self).items()
                if name in _STREAM}
        return kept | {'forward': [model.state() for model in self._models]
                       if self._testing else []}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state of the same wheels, track and time step."""
        for name in _STREAM:
            setattr(self, name, copy.deepcopy(state[name]))
        if self._testing:
            for model, kept in zip(self._models, state['forward'], strict=True):
                model.restore(kept)


# What a ClosedLoop carries from block to block besides its forward runs.
_STREAM = ('_found', '_order', '_history', '_distance', '_last', '_direction', '_due', '_done',
           '_testing', '_high_pass', '_filters', '_power')


@njit(cache=True, nogil=True)
def _remember(moved, leading, behind, order, grid, history, distance, last, expected):
    """Lay the irregularity of the leading wheel down, and tell what lies under every wheel.

    moved (n,) [m] between samples; leading (n, lines); behind (wheels,) [m] of the wheels in
    order. expected (n, lines, wheels) is by cubic interpolation, NaN where nothing is known.
    """
    lines, cells = history.shape
    for k in range(moved.size):
        before, now = distance[0], distance[0] + moved[k]
        cell = int(before / grid) + 1
        while cell * grid <= now:
            share = (cell * grid - before) / (now - before)
            for n in range(lines):
                history[n, cell % cells] = last[n, 0] + share * (leading[k, n] - last[n, 0])
            cell += 1
        distance[0] = now
        for n in range(lines):
            last[n, 0] = leading[k, n]
            expected[k, n, order[0]] = leading[k, n]
        for w in range(1, behind.size):
            at = (now - behind[w]) / grid
            low = int(np.floor(at))
            s = at - low
            for n in range(lines):
                if low < 1 or (low + 2) * grid > now:
                    expected[k, n, order[w]] = np.nan
                    continue
                y0, y1 = history[n, (low - 1) % cells], history[n, low % cells]
                y2, y3 = history[n, (low + 1) % cells], history[n, (low + 2) % cells]
                expected[k, n, order[w]] = (
                    -s * (s - 1.0) * (s - 2.0) / 6.0 * y0
                    + (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0 * y1
                    - (s + 1.0) * s * (s - 2.0) / 2.0 * y2 + (s + 1.0) * s * (s - 1.0) / 6.0 * y3)
