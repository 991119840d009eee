"""The stretch of a recording that is replayed, cut out of the run while it is estimated."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.bags.bag import Bag
from railtrack_ros.bags.codec import SECOND, WaveformBlock
from railtrack_ros.bags.reader import read_waveforms
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import EstimateBlock
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.estimation.timeline import SAME_RATE
from railtrack_ros.runs.replay_model import Samples, run_up
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

ESTIMATED = ('contact_force', 'rail_deflection', 'irregularity')
TRUTH = '/truth/'
TRUTH_MARGIN = 5 * SECOND      # by which truth may be logged before or after its measurement


@dataclass(frozen=True)
class Bound:
    """One end of a stretch: a track position [m] or a time after the first sample [s]."""

    value: float
    unit: str

    @classmethod
    def parse(cls, text: str) -> Bound:
        """Read '120' or '120m' (metres) or '4.5s' (seconds)."""
        match = re.fullmatch(r'\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(m|s)?\s*', text)
        try:
            return cls(float(match.group(1) if match else ''), (match and match.group(2)) or 'm')
        except ValueError:
            raise InputError(f'expected a track position such as 120 or 120m, or a time after the '
                             f'first sample such as 4.5s, got {text!r}') from None

    def __str__(self) -> str:
        """Return the bound as a reader would write it."""
        return f'{self.value:g} {self.unit}'


@dataclass(frozen=True)
class Stretch:
    """What part of a run is meant; None: from its beginning, to its end."""

    begin: Bound | None = None
    end: Bound | None = None

    def __post_init__(self) -> None:
        begin, end = self.begin, self.end
        if begin and end and begin.unit == end.unit and not begin.value < end.value:
            raise InputError(f'the stretch from {begin} to {end} is empty')

    def holds(self, time: Array, position: Array) -> NDArray[np.bool_]:
        """Tell which samples (n,) belong to the stretch; one without a position does not."""
        inside = np.isfinite(position)
        for bound, sign in ((self.begin, 1.0), (self.end, -1.0)):
            if bound is not None:
                where = time if bound.unit == 's' else position
                inside &= sign * (where - bound.value) >= 0.0
        return inside

    def __str__(self) -> str:
        """Return the stretch as a reader would write it."""
        return f'from {self.begin or "the beginning"} to {self.end or "the end"}'


@dataclass(frozen=True)
class _Piece:
    """A block of the run with its estimate, or a gap (without either)."""

    start_ns: int
    size: int
    duration: float
    distance: float
    measured: Mapping[str, Array]
    estimate: EstimateBlock | None
    inside: NDArray[np.bool_]
    log_time: int


class StretchCutter:
    """Takes the blocks of a run one after the other and keeps the stretch and what it needs.

    Memory holds the stretch with its run-up and run-out, however long the run is.

    Attributes
    ----------
    begin, end
        Further bounds of the stretch, in seconds after the first sample.
    begun, ended
        When the first and the last sample of the stretch came, in seconds after the first sample
        of the run; begun is None before.
    """

    def __init__(self, stretch: Stretch, settings: EstimatorSettings, vehicle: Vehicle,
                 first_ns: int | None = None, begin: float = -math.inf) -> None:
        self.stretch = stretch
        self.begin, self.end = begin, math.inf
        self.begun: float | None = None
        self.ended = -math.inf
        self._settings = settings
        self._names = [box.name for box in vehicle.axle_boxes]
        self._pieces: deque[_Piece] = deque()
        self._lead = [0.0, 0.0]           # s and m before the last block
        self._begun = False
        self._after: list[float] | None = None    # s and m since the stretch ended
        self._first_ns = first_ns
        self._end_ns = 0
        self._step: float | None = None
        self._covered = [math.inf, -math.inf]
        self._duration = 0.0

    @property
    def first_ns(self) -> int | None:
        """Time of the first sample of the run [ns since the epoch]."""
        return self._first_ns

    def add(self, block: WaveformBlock, estimate: EstimateBlock, log_time: int = 0) -> None:
        """Take the next block that the estimator has accepted, its estimate, and when it came.

        Raises
        ------
        InputError
            The clock was set back or the sample rate changed within the stretch.
        """
        if self._first_ns is None:
            self._first_ns = block.start_ns
        if self._step is None and block.samples > 1:
            self._step = float(f'{block.time_step:.7g}')
        step = self._step or block.time_step
        if not math.isfinite(step):
            raise InputError('replay: blocks of a single sample have no sample rate')
        begin = (block.start_ns - self._first_ns) / SECOND
        time = np.asarray(begin + step * np.arange(block.samples), dtype=np.float64)
        inside = self.stretch.holds(time, estimate.position)
        inside &= (time >= self.begin) & (time < self.end)
        if self.begun is None and inside.any():
            self.begun = float(time[inside.argmax()])
        if inside.any():
            self.ended = float(time[inside][-1])
        finite = estimate.position[np.isfinite(estimate.position)]
        if finite.size:
            self._covered = [min(self._covered[0], float(finite.min())),
                             max(self._covered[1], float(finite.max()))]
        self._duration = float(time[-1])
        if self.is_over:
            return
        self._fill_gap(block, step)
        speed = np.abs(np.nan_to_num(estimate.speed))
        self._append(_Piece(
            block.start_ns, block.samples, block.samples * step, float(speed.sum()) * step,
            {name: np.asarray(block.channels[name], dtype=float)
             for name in self._names if name in block.channels}, estimate, inside, log_time))
        self._end_ns = block.end_ns + round(step * SECOND)

    @property
    def is_over(self) -> bool:
        """Whether stretch and run-out are complete."""
        _, _, seconds, metres = run_up(self._settings)
        after = self._after
        return after is not None and _is_enough(after[0], after[1], seconds, metres)

    def _fill_gap(self, block: WaveformBlock, step: float) -> None:
        if not self._pieces:
            return
        gap = (block.start_ns - self._end_ns) / SECOND
        if gap < -self._settings.gap_tolerance:
            if self._begun:
                raise InputError('the clock of the recording was set back within the stretch: '
                                 'choose a stretch on one side of that with --from and --to')
            self._pieces.clear()
            self._lead = [0.0, 0.0]
        elif block.samples > 1 and abs(block.time_step / step - 1.0) > SAME_RATE:
            raise InputError('the sample rate changes within the stretch: choose a stretch on one '
                             'side of that with --from and --to')
        elif gap > self._settings.gap_tolerance:
            size = round(gap / step)
            self._append(_Piece(self._end_ns, size, gap, 0.0, {}, None,
                                np.zeros(size, dtype=bool), self._pieces[-1].log_time))

    def _append(self, piece: _Piece) -> None:
        self._pieces.append(piece)
        if piece.inside.any():
            self._begun = True
            self._after = None
        elif self._begun:
            before = self._after or [0.0, 0.0]
            self._after = [before[0] + piece.duration, before[1] + piece.distance]
        if not self._begun:
            metres, seconds, _, _ = run_up(self._settings)
            self._lead[0] += piece.duration
            self._lead[1] += piece.distance
            while _is_enough(self._lead[0] - self._pieces[0].duration,
                             self._lead[1] - self._pieces[0].distance, seconds, metres):
                gone = self._pieces.popleft()
                self._lead[0] -= gone.duration
                self._lead[1] -= gone.distance

    def finish(self, bag: Bag) -> tuple[Samples, slice]:
        """Return the samples and which of them are the stretch, with the truth of the recording.

        Raises
        ------
        InputError
            The stretch lies outside the run, or nothing of the run could be estimated.
        """
        if not self._begun or self._step is None:
            if not math.isfinite(self._covered[0]):
                raise InputError(f'{bag.path}: nothing to replay, the run has no speed or no '
                                 'acceleration that can be used')
            raise InputError(
                f'{bag.path}: the stretch {self.stretch} lies outside the run, which covers '
                f'{self._covered[0]:.1f} m to {self._covered[1]:.1f} m in {self._duration:.2f} s')
        step = self._step
        position = self._joined(lambda e: e.position)
        known = np.flatnonzero(np.isfinite(position))
        part = slice(int(known[0]), int(known[-1]) + 1)
        inside = np.flatnonzero(np.concatenate([p.inside for p in self._pieces])[part])
        time_ns = np.concatenate([
            p.start_ns + np.round(step * np.arange(p.size) * SECOND).astype(np.int64)
            for p in self._pieces])[part]
        speed = self._joined(lambda estimate: estimate.speed)
        estimated = {
            quantity: {name: self._channel(quantity, name)[part] for name in self._names}
            for quantity in ESTIMATED}
        measured = {name: np.concatenate([
            p.measured.get(name, np.full(p.size, np.nan)) for p in self._pieces])[part]
            for name in self._names}
        numbers = np.arange(part.stop - part.start)
        good = known - part.start
        assert self._first_ns is not None
        samples = Samples(
            start_ns=int(time_ns[0]), time_step=step,
            start_time=(int(time_ns[0]) - self._first_ns) / SECOND,
            position=np.interp(numbers, good, position[known]),
            speed=np.interp(numbers, good, speed[known]),
            measured=measured, estimated=estimated,
            truth=_truth(bag, time_ns, self._names, self._log_times()))
        return samples, slice(int(inside[0]), int(inside[-1]) + 1)

    def _log_times(self) -> tuple[int, int]:
        """Return log times [ns] between which the truth of the pieces is recorded."""
        times = [piece.log_time for piece in self._pieces]
        return min(times) - TRUTH_MARGIN, max(times) + TRUTH_MARGIN

    def _channel(self, quantity: str, name: str) -> Array:
        return self._joined(lambda estimate: getattr(estimate, quantity)[name])

    def _joined(self, of: Callable[[EstimateBlock], Array]) -> Array:
        return np.concatenate([np.full(p.size, np.nan) if p.estimate is None else of(p.estimate)
                               for p in self._pieces])


def _is_enough(time: float, distance: float, seconds: float, metres: float) -> bool:
    """Tell whether a time [s] in which a distance [m] was run holds so many metres and seconds."""
    return distance > metres and time * (1.0 - metres / distance) >= seconds


def _truth(bag: Bag, time_ns: NDArray[np.int64], names: list[str], log_time: tuple[int, int]
           ) -> dict[str, dict[str, Array]]:
    """Return the truth that the recording holds at the times (n,), linear between its samples."""
    topics = {TRUTH + quantity: quantity for quantity in ESTIMATED
              if TRUTH + quantity in bag.topics}
    if not topics:
        return {}
    origin = int(time_ns[0])
    time = (time_ns - origin) / SECOND
    found: dict[str, dict[str, Array]] = {}
    margin = SECOND // 10
    for topic, wave in read_waveforms(
            bag, topics, time_ns=(origin - margin, int(time_ns[-1]) + margin),
            log_time=log_time).items():
        if not wave.time_ns.size:
            continue
        there = wave.time(origin)
        # Between samples that are further apart than usual there is no truth.
        after = np.clip(np.searchsorted(there, time - 1e-9), 0, there.size - 1)
        step = float(np.median(np.diff(there))) if there.size > 1 else math.inf
        apart = (np.abs(there[after] - time) > 1.5 * step)
        for name in (n for n in names if n in wave.channels):
            values = np.interp(time, there, wave.channels[name].astype(float), np.nan, np.nan)
            values[apart] = np.nan
            found.setdefault(topics[topic], {})[name] = values
    return found
