"""Where a block of samples belongs in time: whether it continues the stream, at which rate."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.estimation.notes import Kind, Note

Array = NDArray[np.float64]

SECOND = 1_000_000_000  # ns

# Blocks that come back by more than this [s] tell that the clock was set back. A leap of the stamps
# by more than this, to either side, is believed when a second block goes on from the first.
CLOCK_RESET = 5.0

# How much the expected time of a block follows the stamp of the last one. Stamps jitter; a small
# share halves the disturbance and still follows any drift between sensor and computer.
FOLLOW = 0.1

# Sample periods within this share of one another are of the same rate.
SAME_RATE = 1e-3

# The period of a stream of single samples is the mean over so many: their stamps are rounded to
# nanoseconds and jitter.
SINGLES = 32

# Stamps of single samples further apart [s] than this have a gap between them.
LARGEST_SINGLE = 0.02

# A sample lies off the uniform grid of its block by at most this share of the sample period.
UNIFORMITY = 0.5


class Place(Enum):
    """What a block is to the stream so far."""

    CONTINUED = 'follows the last block'
    STARTED = 'begins a stretch after a gap, or the stream itself'
    REWOUND = 'begins the stream anew: the clock was set back'
    DROPPED = 'cannot be used'
    HELD = 'is one of the first single samples, which tell the rate'


class SampleClock:
    """Checks the times of successive blocks of uniformly sampled data.

    The sample period is that of the first block, rounded to six digits of its rate so that it
    does not depend on the length of that block. A block continues the stream if its stamp is the
    expected one within the tolerance; the expectation follows the stamps, so that a slow drift
    between the clock of the sensor and that of the stamps does no harm. A stream that begins with
    blocks of a single sample loses the first 32 to tell the period.

    Attributes
    ----------
    step
        Sample period [s], None before the first block.
    gap
        Time [s] between the block and the expected one, negative for an overlap.
    begun_ns
        When the clock was set back: its time at the first block thereafter, which was dropped.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self.step: float | None = None
        self.gap = 0.0
        self.begun_ns = 0
        self._leap: tuple[int, int] | None = None  # start of a block that leapt, and of the next
        self._singles: list[int] = []  # stamps of the first samples, of a stream of single ones
        self._start_ns: int | None = None
        self._expected_ns = 0

    def place(self, stamp_ns: int, t: Array) -> tuple[Place, str]:
        """Place a block.

        Parameters
        ----------
        stamp_ns
            Time that `t` counts from [ns].
        t
            (n,) times of the samples after the stamp [s].

        Returns
        -------
        tuple
            The place, and a remark: empty if there is nothing to say.
        """
        problem = self._problem(t)
        if problem:
            return Place.DROPPED, f'block dropped: {problem}'
        start_ns = stamp_ns + round(float(t[0]) * SECOND)
        if t.size == 1 and self.step is None and not self._period_of_singles(start_ns):
            return Place.HELD, ''
        place, remark = self._against_last(start_ns, t)
        if place is Place.DROPPED:
            return place, remark
        if t.size > 1:
            period = float(t[-1] - t[0]) / (t.size - 1)
            if self.step is None:
                self.step = _rounded(period)
            elif abs(period - self.step) > self.step * max(SAME_RATE, UNIFORMITY / (t.size - 1)):
                remark = f'sample rate changed from {1 / self.step:.6g} to {1 / period:.6g} Hz'
                place = place if place is Place.REWOUND else Place.STARTED
                self.step = _rounded(period)
        assert self.step is not None
        self._start_ns, smooth_ns = start_ns, start_ns
        if place is Place.CONTINUED:
            smooth_ns = self._expected_ns + round(FOLLOW * (start_ns - self._expected_ns))
        self._expected_ns = smooth_ns + round(t.size * self.step * SECOND)
        return place, remark

    def _problem(self, t: Array) -> str:
        if t.ndim != 1 or t.size == 0 or not np.isfinite(t).all():
            return 'expected at least one finite sample time'
        if t.size == 1:
            return ''
        period = (t[-1] - t[0]) / (t.size - 1)
        if not period > 0.0:
            return 'the sample times do not increase'
        off = np.abs(t - t[0] - period * np.arange(t.size)).max()
        if off > UNIFORMITY * period:
            return f'a sample lies {off / period:.2g} sample periods off the uniform grid'
        return ''

    def _period_of_singles(self, start_ns: int) -> bool:
        """Take the stamp of a single sample; tells whether they give the period now."""
        if self._singles and start_ns <= self._singles[-1]:
            self._singles.clear()
        self._singles.append(start_ns)
        if len(self._singles) <= SINGLES:
            return False
        steps = np.diff(self._singles)
        self._singles.clear()
        if steps.max() > 2.0 * np.median(steps) + self.tolerance * SECOND:
            return False  # a gap: try anew
        self.step = _rounded(float(steps.mean()) / SECOND)
        return True

    def _against_last(self, start_ns: int, t: Array) -> tuple[Place, str]:
        if self._start_ns is None or self.step is None:
            return Place.STARTED, ''
        leap, self._leap = self._leap, None
        self.gap = (start_ns - self._expected_ns) / SECOND
        if abs(self.gap) <= self.tolerance:
            return Place.CONTINUED, ''
        back = (self._start_ns - start_ns) / SECOND
        if max(back, self.gap) > CLOCK_RESET:
            if leap is None or abs(start_ns - leap[1]) > self.tolerance * SECOND:
                period = float(t[-1] - t[0]) / (t.size - 1) if t.size > 1 else self.step
                self._leap = start_ns, start_ns + round(t.size * period * SECOND)
                side = f'{back:.3f} s before' if back > 0.0 else f'{self.gap:.3f} s after'
                return Place.DROPPED, Note(
                    f'block dropped: stamped {side} the expected time, which is believed when the '
                    'next one goes on from it', Kind.LEAP)
            self.begun_ns = leap[0]
            if back > 0.0:
                return Place.REWOUND, f'the clock was set back by {back:.3f} s: start anew'
        if back == 0.0:
            return Place.DROPPED, Note(
                'block dropped: it has the stamp of the last one', Kind.NORMAL)
        if back > 0.0:
            return Place.DROPPED, Note(
                f'block dropped: {back:.3f} s before the last one', Kind.NORMAL)
        if self.gap < 0.0:
            return Place.STARTED, f'blocks overlap by {-self.gap * 1e3:.3g} ms: start anew'
        lost = math.floor(self.gap / self.step + 0.5)
        return Place.STARTED, Note(
            f'gap of {self.gap:.4g} s ({lost} samples): start anew',
            Kind.LONG_GAP if self.gap > CLOCK_RESET else Kind.GAP)


class SamplePeriod:
    """Sample period [s] of a stream of blocks: within a block, else from stamp to stamp.

    `step` is NaN before it is known.
    """

    def __init__(self) -> None:
        self.step = math.nan
        self._first_ns, self._last_ns, self._count = 0, 0, 0

    def take(self, stamp_ns: int, t: Array) -> None:
        """Take the times t (n,) [s] after a stamp [ns] of the next block."""
        if t.size > 1:
            self.step = (float(t[-1]) - float(t[0])) / (t.size - 1)
        if t.size != 1:
            self._count = 0
            return
        now_ns = stamp_ns + round(float(t[0]) * SECOND)
        # From the first single sample to this one, unless a gap lies between.
        if self._count and 0 < now_ns - self._last_ns <= LARGEST_SINGLE * SECOND:
            self.step = (now_ns - self._first_ns) / (self._count * SECOND)
        else:
            self._first_ns, self._count = now_ns, 0
        self._last_ns = now_ns
        self._count += 1


def _rounded(period: float) -> float:
    """Return a sample period [s] with its rate rounded to six digits."""
    return 1.0 / float(f'{1.0 / period:.6g}')
