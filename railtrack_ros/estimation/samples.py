"""Single samples of several sensors gathered into blocks, for sensors of up to about 1 kHz.

One axle box gives the time: a block is so many successive samples of its own, and the samples of
the others are brought to its times by linear interpolation, which leaves those with equal stamps
as they are. Which samples make a block depends on stamps alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.estimation.timeline import SECOND

Array = NDArray[np.float64]

# Successive samples this many periods apart have lost one between them.
MISSING = 1.5

# Samples from which the period is told, and time after which a silent sensor is waited for no
# longer [s].
FIRST = 32
PATIENCE = 0.1

# Length of a block [s], unless something else is said.
SAMPLE_BLOCK = 0.05


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """Stamp [ns], times after it (n,) [s], uniform, and samples (n,) by axle box."""

    stamp_ns: int
    t: Array
    channels: dict[str, Array]


class SampleCollector:
    """Gathers samples of the axle boxes `names` into blocks of about `duration` [s].

    Attributes
    ----------
    dropped
        Number of samples that came with a stamp not after that of the last one.
    """

    def __init__(self, names: Sequence[str], duration: float) -> None:
        self.dropped = 0
        self._names = tuple(names)
        self._duration = duration
        self._samples: dict[str, deque[tuple[int, float]]] = {name: deque() for name in names}
        self._newest: dict[str, int] = {}
        self._clock: str | None = None
        self._period = 0  # ns

    def add(self, name: str, stamp_ns: int, value: float) -> list[SampleBlock]:
        """Take a sample of an axle box; return the blocks that it completes."""
        newest = self._newest.get(name)
        if newest is not None and stamp_ns <= newest:
            if newest - stamp_ns < 5 * SECOND:
                self.dropped += 1
                return []
            self._restart()  # the clock was set back
        self._newest[name] = stamp_ns
        self._samples[name].append((stamp_ns, value))
        self._choose_clock()
        blocks = []
        while (block := self._next_block()) is not None:
            blocks.append(block)
        return blocks

    def _restart(self) -> None:
        self._newest.clear()
        self._clock, self._period = None, 0
        for samples in self._samples.values():
            samples.clear()

    def _now(self) -> int:
        return max(self._newest.values())

    def _silent(self, name: str) -> bool:
        return self._now() - self._newest.get(name, -(2**62)) > PATIENCE * SECOND

    def _choose_clock(self) -> None:
        """Let the first axle box that is not silent give the time."""
        if self._clock is not None and not self._silent(self._clock):
            return
        self._clock = next(name for name in self._names if not self._silent(name))
        self._period = 0

    def _next_block(self) -> SampleBlock | None:
        assert self._clock is not None
        own = self._samples[self._clock]
        if len(own) < FIRST:
            return None
        if not self._period:
            stamps = [stamp for stamp, _ in list(own)[:FIRST]]
            self._period = int(np.median(np.diff(stamps)))
        size = max(round(self._duration * SECOND / self._period), 2)
        stamps = [stamp for stamp, _ in list(own)[: size + 1]]
        apart = np.diff(stamps)
        gaps = np.flatnonzero(apart[: size] > MISSING * self._period)
        if gaps.size:
            size = int(gaps[0]) + 1
        elif len(stamps) < size:
            return None
        last = stamps[size - 1]
        if any(self._newest.get(name, last) < last and not self._silent(name)
               for name in self._names):
            return None
        return self._take(size, np.array(stamps[:size]))

    def _take(self, size: int, stamps: NDArray[np.int64]) -> SampleBlock:
        """Remove a block of so many samples of the axle box that gives the time."""
        assert self._clock is not None
        first, last = int(stamps[0]), int(stamps[-1])
        channels = {}
        for name, samples in self._samples.items():
            channels[name] = self._at(stamps, samples)
            # One sample before the next block stays, for the interpolation.
            keep = last + 1 if name == self._clock else last - self._period // 2
            while samples and (samples[0][0] < keep and (
                    name == self._clock or (len(samples) > 1 and samples[1][0] <= keep))):
                samples.popleft()
        step = (last - first) / (size - 1) if size > 1 else self._period
        return SampleBlock(first, np.arange(size) * step / SECOND, channels)

    def _at(self, stamps: NDArray[np.int64], samples: deque[tuple[int, float]]) -> Array:
        """Values (n,) at stamps (n,), NaN where no sample is near on both sides."""
        if not samples:
            return np.full(stamps.size, np.nan)
        times = np.array([stamp for stamp, _ in samples])
        values = np.array([value for _, value in samples])
        after = np.searchsorted(times, stamps)
        before = np.searchsorted(times, stamps, side='right') - 1
        known = (after < times.size) & (before >= 0)
        after, before = np.minimum(after, times.size - 1), np.maximum(before, 0)
        width = times[after] - times[before]
        weight = np.where(width > 0, (stamps - times[before]) / np.maximum(width, 1), 0.0)
        value = np.where(weight > 0.0, (1.0 - weight) * values[before] + weight * values[after],
                         values[before])
        return np.where(known & (width <= 2.0 * MISSING * self._period), value, np.nan)
