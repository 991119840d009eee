"""What is done to samples before anybody works with them: decimation, a sensor's high-pass undone.

Both work on gapless stretches of uniform samples.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import signal

from railtrack_ros.bags.columns import Array, Column, Stored, pieces

STOP_BAND_ATTENUATION = 100.0  # dB

# Missing samples are bridged from one neighbour to the other where these are as near as this.
BRIDGE = 1 << 14


class Decimator:
    """Linear-phase anti-aliasing filter and decimation of a stream, without delay.

    Passes 80 % of the new Nyquist band; what would fold into that is down by
    :data:`STOP_BAND_ATTENUATION`. Before the first sample the signal is taken as constant.

    Attributes
    ----------
    reach
        Number of samples on either side of a sample which enter its filtered value.
    taps
        The filter (2 reach + 1,).
    """

    def __init__(self, factor: int) -> None:
        transition = 0.4 / factor  # of the old Nyquist frequency
        taps, beta = signal.kaiserord(STOP_BAND_ATTENUATION, transition)
        taps += 1 - taps % 2
        self._factor = factor
        self.taps = signal.firwin(taps, 1.0 / factor, window=('kaiser', beta))
        self.reach = taps // 2
        self._kept: Array | None = None

    def process(self, values: Array) -> Array:
        """Return the samples (m, channels) that the next `values` (n, channels) complete."""
        if self._kept is None:
            self._kept = np.repeat(values[:1], self.reach, axis=0)
        known = np.concatenate([self._kept, values])
        if len(known) < len(self.taps):
            self._kept = known
            return known[:0]
        surroundings = sliding_window_view(known, len(self.taps), axis=0)[::self._factor]
        self._kept = known[len(surroundings) * self._factor:]
        return surroundings @ self.taps


class Decimated:
    """Every `factor`-th sample of a column, after the filter of :class:`Decimator`.

    Before the first and after the last sample the signal is taken as constant. Where a
    missing sample (NaN) enters with more than a hundredth of the weight, the result is NaN too.
    """

    def __init__(self, column: Column, factor: int) -> None:
        self.size = -(-column.size // factor)
        self._column, self._factor = column, factor
        self._decimator = Decimator(factor)

    def __getitem__(self, part: slice) -> Array:
        """Return a stretch."""
        start, stop, _ = part.indices(self.size)
        if stop <= start:
            return np.zeros(0)
        reach, factor = self._decimator.reach, self._factor
        first, last = start * factor - reach, (stop - 1) * factor + reach + 1
        values, ahead = _around(self._column, first, last)
        missing = np.isnan(values)
        filled = _filled(values, missing)
        # At the ends of the column the signal is constant.
        filled = np.pad(filled, (max(-first, 0), max(last - self._column.size, 0)), 'edge')
        begin = max(first - ahead, 0)
        window = sliding_window_view(filled[begin:begin + last - first], 2 * reach + 1)
        found = window[::factor] @ self._decimator.taps
        if missing.any():
            near = np.convolve(missing, np.ones(2 * factor + 1), 'same')
            found[near[start * factor - ahead:][::factor][:stop - start] > 0.5] = np.nan
        return found


def without_high_pass(
    column: Column, step: float, frequency: float, order: int, lowest: float, result: Stored
) -> Stored:
    """Give samples with the Butterworth high-pass of a sensor moved to a lower frequency.

    The inverse of a high-pass alone would amplify drift without bound; so the filter is
    multiplied by H_lowest / H_frequency, two high-passes of the same order: above `lowest` the
    sensor's one is undone in level and phase.

    Parameters
    ----------
    column
        Samples, NaN where missing: bridged by a straight line for the filter, NaN again after it.
    step
        Sample period [s].
    frequency, order
        -3 dB corner [Hz] of the sensor's high-pass, and its order.
    lowest
        New corner [Hz], below `frequency`.
    result
        An empty column, which is filled and returned.
    """
    poles = {
        corner: signal.butter(order, 2.0 * math.pi * corner, 'high', analog=True, output='zpk')[1]
        for corner in (frequency, lowest)
    }
    sections = signal.zpk2sos(*signal.bilinear_zpk(poles[frequency], poles[lowest], 1.0,
                                                   1.0 / step))
    state = np.zeros((len(sections), 2))
    for part in pieces(column.size):
        values, ahead = _around(column, part.start, part.stop)
        missing = np.isnan(values)
        inside = slice(part.start - ahead, part.stop - ahead)
        found, state = signal.sosfilt(sections, _filled(values, missing)[inside], zi=state)
        found[missing[inside]] = np.nan
        result.append(found)
    return result


def _around(column: Column, first: int, last: int) -> tuple[Array, int]:
    """Return samples first ... last and those around that tell how to bridge, and their first."""
    ahead = max(first - BRIDGE, 0)
    return column[ahead:min(last + BRIDGE, column.size)], ahead


def _filled(values: Array, missing: NDArray[np.bool_]) -> Array:
    """Bridge missing samples by straight lines; zeros where none is known."""
    if not missing.any():
        return values
    known = np.flatnonzero(~missing)
    if not known.size:
        return np.zeros(values.size)
    return np.interp(np.arange(values.size), known, values[known])
