"""An eye on the messages: stamps of the blocks, what the sensors look like, how the speed comes.

Plain arrays and times; nothing here changes a result.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

SECOND = 1_000_000_000  # ns

# Without a known full scale: as many equal samples at an extreme are a saturated sensor, if they
# are beyond this acceleration [m/s2] (at rest a coarse converter repeats itself too).
REPEATED = 3
REPEATED_ABOVE = 30.0


@dataclass
class Signal:
    """What a channel looked like since the last :meth:`BlockWatch.take`.

    samples, saturated: numbers of samples. mean: of the acceleration [m/s2], NaN where there was
    none. stuck: time [s] for which it has had its present value.
    """

    samples: int = 0
    saturated: int = 0
    mean: float = float('nan')
    stuck: float = 0.0


@dataclass
class Stamps:
    """What the stamps of the blocks were like since the last :meth:`BlockWatch.take`.

    duplicates, out_of_order: numbers of blocks with the stamp of the last one, and of earlier
    ones. jumps: times that the stamps jumped against the times of sending, `jump` [s] the largest.
    offset: time of sending less the end of the block [s], of the last block; NaN without one.
    """

    blocks: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    jumps: int = 0
    jump: float = 0.0
    offset: float = float('nan')


@dataclass
class _Last:
    start_ns: int
    end_ns: int
    sent_ns: int


@dataclass
class BlockWatch:
    """Watches the channels of the axle boxes `names`.

    full_scale [m/s2] (0: not known) and jump_limit [s] may change at any time.
    """

    names: Sequence[str]
    full_scale: float = 0.0
    jump_limit: float = 0.5
    stamps: Stamps = field(default_factory=Stamps)
    _last: _Last | None = None

    def __post_init__(self) -> None:
        count = len(self.names)
        self._value: NDArray[np.float32] = np.full(count, np.nan, np.float32)
        self._held: NDArray[np.float64] = np.zeros(count)
        self._begin()

    def _begin(self) -> None:
        count = len(self.names)
        self.stamps = Stamps()
        self._saturated = np.zeros(count, np.int64)
        self._sum = np.zeros(count)
        self._samples = np.zeros(count, np.int64)

    def block(self, stamp_ns: int, t: NDArray[np.float64], sent_ns: int,
              channels: Mapping[str, NDArray[np.floating]]) -> None:
        """Take a block: its stamp [ns], t (n,) [s], when it was sent [ns], channels (n,)."""
        self.place(stamp_ns, t, sent_ns)
        missing = np.full(t.size, np.nan, np.float32)
        values = np.array([channels.get(name, missing) for name in self.names], np.float32)
        duration = t.size * float(t[-1] - t[0]) / max(t.size - 1, 1)
        low, high = values.min(axis=1), values.max(axis=1)
        good = np.isfinite(low) & np.isfinite(high)
        constant = good & (low == high)
        self._held = np.where(constant & (low == self._value), self._held + duration,
                              np.where(constant, duration, 0.0))
        self._value = np.where(constant, low, np.float32(np.nan))
        self._saturated += np.where(constant, 0, self._extremes(values, low, high))
        with np.errstate(invalid='ignore', over='ignore'):
            self._sum[good] += values[good].sum(axis=1, dtype=np.float64)
        self._samples[good] += t.size

    def place(self, stamp_ns: int, t: NDArray[np.float64], sent_ns: int) -> None:
        """Judge the stamp of a block against the one before and against the time of sending."""
        start_ns = stamp_ns + round(float(t[0]) * SECOND)
        end_ns = stamp_ns + round(float(t[-1]) * SECOND)
        stamps, last = self.stamps, self._last
        stamps.blocks += 1
        stamps.offset = (sent_ns - end_ns) / SECOND
        if last is not None:
            stamps.duplicates += start_ns == last.start_ns
            stamps.out_of_order += start_ns < last.start_ns
            unexpected = (start_ns - last.end_ns) / SECOND
            against_sending = (start_ns - last.start_ns - (sent_ns - last.sent_ns)) / SECOND
            if min(abs(unexpected), abs(against_sending)) > self.jump_limit:
                stamps.jumps += 1
                if abs(against_sending) > abs(stamps.jump):
                    stamps.jump = against_sending
        self._last = _Last(start_ns, end_ns, sent_ns)

    def _extremes(self, values: NDArray[np.float32], low: NDArray[np.float32],
                  high: NDArray[np.float32]) -> NDArray[np.int64]:
        """Number of saturated samples of each channel of values (channels, n)."""
        if self.full_scale > 0.0:
            return np.count_nonzero(np.abs(values) >= 0.999 * self.full_scale, axis=1)
        count = np.zeros(len(values), np.int64)
        for extreme in (low, high):
            at = (values == extreme[:, None]) & (np.abs(extreme) > REPEATED_ABOVE)[:, None]
            # A run of r samples, r >= 3, holds r - 2 triples.
            triples = at[:, :-2] & at[:, 1:-1] & at[:, 2:]
            runs = np.count_nonzero(triples[:, 1:] & ~triples[:, :-1], axis=1) + (
                triples[:, 0] if triples.shape[1] else 0)
            count += np.count_nonzero(triples, axis=1) + (REPEATED - 1) * runs
        return count

    def take(self) -> tuple[Stamps, dict[str, Signal]]:
        """Return what was seen since the last call."""
        stamps = self.stamps
        signals = {
            name: Signal(
                int(self._samples[i]), int(self._saturated[i]),
                float(self._sum[i] / self._samples[i]) if self._samples[i] else float('nan'),
                float(self._held[i]),
            )
            for i, name in enumerate(self.names)
        }
        self._begin()
        return stamps, signals


class SpeedWatch:
    """Watches how fast the measured speed changes, and whether it comes at all.

    Parameters
    ----------
    now
        Monotonic time, s.

    Attributes
    ----------
    interval
        Time between the stamps of the last two messages [s], NaN before the second.
    """

    # Time over which a change is told [s]: long enough for the resolution of an odometer.
    WINDOW = 0.5

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._recent: deque[tuple[int, float]] = deque(maxlen=1000)
        self._largest = 0.0
        self._now = now
        self._came = now()
        self.interval = float('nan')

    def add(self, stamp_ns: int, speed: float) -> None:
        """Take a speed message [ns], [m/s]."""
        self._came = self._now()
        recent = self._recent
        if recent and stamp_ns <= recent[-1][0]:
            recent.clear()
        elif recent:
            self.interval = (stamp_ns - recent[-1][0]) / SECOND
        recent.append((stamp_ns, speed))
        while len(recent) > 2 and stamp_ns - recent[1][0] >= self.WINDOW * SECOND:
            recent.popleft()
        seconds = (stamp_ns - recent[0][0]) / SECOND
        if self.WINDOW <= seconds < 4.0 * self.WINDOW:
            change = (speed - recent[0][1]) / seconds
            self._largest = max(self._largest, change, -change)

    @property
    def silence(self) -> float:
        """Time [s] since a message last came; before the first one: since the beginning."""
        return self._now() - self._came

    def take(self) -> float:
        """Return the largest change [m/s2] since the last call."""
        largest, self._largest = self._largest, 0.0
        return largest
