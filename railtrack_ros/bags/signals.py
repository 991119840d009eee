"""What is done to samples before anybody works with them: decimation, a sensor's high-pass undone.

Both work on gapless stretches of uniform samples.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.float64]

STOP_BAND_ATTENUATION = 100.0  # dB


class Decimator:
    """Linear-phase anti-aliasing filter and decimation of a stream, without delay.

    Passes 80 % of the new Nyquist band; what would fold into that is down by
    :data:`STOP_BAND_ATTENUATION`. Before the first sample the signal is taken as constant.

    Attributes
    ----------
    reach
        Number of samples on either side of a sample which enter its filtered value.
    """

    def __init__(self, factor: int) -> None:
        transition = 0.4 / factor  # of the old Nyquist frequency
        taps, beta = signal.kaiserord(STOP_BAND_ATTENUATION, transition)
        taps += 1 - taps % 2
        self._factor = factor
        self._taps = signal.firwin(taps, 1.0 / factor, window=('kaiser', beta))
        self.reach = taps // 2
        self._kept: Array | None = None

    def process(self, values: Array) -> Array:
        """Return the samples (m, channels) that the next `values` (n, channels) complete."""
        if self._kept is None:
            self._kept = np.repeat(values[:1], self.reach, axis=0)
        known = np.concatenate([self._kept, values])
        if len(known) < len(self._taps):
            self._kept = known
            return known[:0]
        surroundings = sliding_window_view(known, len(self._taps), axis=0)[::self._factor]
        self._kept = known[len(surroundings) * self._factor:]
        return surroundings @ self._taps


def decimated(values: Array, factor: int) -> Array:
    """Return every `factor`-th sample of (n,), after the filter of :class:`Decimator`.

    Before the first and after the last sample the signal is taken as constant. Where a
    missing sample (NaN) enters with more than a hundredth of the weight, the result is NaN too.
    """
    missing = np.isnan(values)
    filled = _filled(values, missing)
    decimator = Decimator(factor)
    end = np.repeat(filled[-1:], decimator.reach)
    found = decimator.process(np.concatenate([filled, end])[:, None])[:, 0]
    found = found[: -(-values.size // factor)]
    if missing.any():
        near = np.convolve(missing, np.ones(2 * factor + 1), 'same')[::factor]
        found[near > 0.5] = np.nan
    return found


def without_high_pass(
    values: Array, step: float, frequency: float, order: int, lowest: float
) -> Array:
    """Return samples (n,) with the Butterworth high-pass of a sensor moved to a lower frequency.

    The inverse of a high-pass alone would amplify drift without bound; so the filter is
    multiplied by H_lowest / H_frequency, two high-passes of the same order: above `lowest` the
    sensor's one is undone in level and phase.

    Parameters
    ----------
    values
        Samples, NaN where missing: bridged by a straight line for the filter, NaN again after it.
    step
        Sample period [s].
    frequency, order
        -3 dB corner [Hz] of the sensor's high-pass, and its order.
    lowest
        New corner [Hz], below `frequency`.
    """
    missing = np.isnan(values)
    poles = {
        corner: signal.butter(order, 2.0 * math.pi * corner, 'high', analog=True, output='zpk')[1]
        for corner in (frequency, lowest)
    }
    digital = signal.bilinear_zpk(poles[frequency], poles[lowest], 1.0, 1.0 / step)
    result = np.asarray(signal.sosfilt(signal.zpk2sos(*digital), _filled(values, missing)))
    result[missing] = np.nan
    return result


def _filled(values: Array, missing: NDArray[np.bool_]) -> Array:
    """Bridge missing samples by straight lines; zeros where none is known."""
    if not missing.any():
        return values
    known = np.flatnonzero(~missing)
    if not known.size:
        return np.zeros(values.size)
    return np.interp(np.arange(values.size), known, values[known])
