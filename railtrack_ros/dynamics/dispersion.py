"""Dispersion of the periodic track: the Bloch waves which it carries at each frequency.

A wave takes the factor mu = exp(-i kappa l) from one bay to the next, l the sleeper spacing;
kappa = i ln(mu) / l is its Bloch wavenumber.  The imaginary part (never positive for the wave
that goes right) is its decay, 8.686 |Im kappa| dB/m.  The real part is only given up to 2 pi / l
by one frequency; here it is followed up from low frequency, so that it runs on through the
pinned-pinned stop band at pi / l as the wavenumber of the rail's own wave does.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from railtrack_ros.dynamics.receptance import AT_A_TIME, checked_frequencies
from railtrack_ros.track.description import Track
from railtrack_ros.track.exact import ComplexArray, ExactBay
from railtrack_ros.track.infinite import InfiniteRow
from railtrack_ros.track.rail import pinned_pinned_frequency

DECIBELS = 20.0 / math.log(10.0)  # dB of a decay by exp(-1)
FINEST_STEP = 2.0  # [Hz] between frequencies when a branch is followed


def bloch_wavenumbers(track: Track, frequencies: ArrayLike) -> ComplexArray:
    """Find the wavenumbers kappa (f, 2) [1/m] of the two waves that go right.

    They are exp(i (omega t - kappa x)) from bay to bay.  Both branches are followed from low to
    high frequency; the first is the one which decays less at the pinned-pinned frequency, the
    second the near field there.  frequencies: (f,) Hz in any order.

    Raises InputError for frequencies that are not above zero.
    """
    wanted = checked_frequencies(frequencies)
    pinned = pinned_pinned_frequency(track.rail, track.support.spacing)
    lowest, highest = min(1.0, float(wanted.min())), max(pinned, float(wanted.max()))
    steps = math.ceil((highest - lowest) / FINEST_STEP) + 1
    grid = np.unique(np.concatenate([np.linspace(lowest, highest, steps), wanted, [pinned]]))
    logarithms = np.log(np.concatenate([
        InfiniteRow(ExactBay(track, grid[i:i + AT_A_TIME])).waves.factors
        for i in range(0, grid.size, AT_A_TIME)]))
    followed = _follow(logarithms)
    there = np.searchsorted(grid, pinned)
    if followed[there, 0].real < followed[there, 1].real:
        followed = followed[:, ::-1]
    kappa: ComplexArray = 1j * followed / track.support.spacing
    return kappa[np.searchsorted(grid, wanted)]


def _follow(logarithms: ComplexArray) -> ComplexArray:
    """Order ln mu (f, 2) so that either column changes least from row to row, phases unwrapped."""
    result = logarithms.copy()
    for i in range(1, len(result)):
        before = result[i - 1]
        candidates = []
        for pair in (logarithms[i], logarithms[i, ::-1]):
            turns = np.rint((before.imag - pair.imag) / (2.0 * math.pi))
            pair = pair + 2j * math.pi * turns
            candidates.append((float(np.abs(pair - before).sum()), pair))
        result[i] = min(candidates, key=lambda item: item[0])[1]
    return result
