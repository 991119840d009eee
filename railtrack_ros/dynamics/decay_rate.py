"""Vertical track decay rate in one-third octaves after EN 15461.

The rail is struck at a list of distances from an accelerometer at x0; by reciprocity that is the
response at those distances to a force at x0.  Accelerances A(x_n) averaged over each one-third
octave give

    DR = 4.343 / sum_n |A(x_n)|^2 / |A(x_0)|^2 dx_n   [dB/m],

with dx_n the length of rail for which position n stands.  A wave decaying as exp(-b x) from x0 on
has DR = 8.686 b.  Distances end at 66 bays, so no rate below 4.343 / x_max can be read.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from railtrack_ros.dynamics.receptance import receptances
from railtrack_ros.track.description import Track
from railtrack_ros.track.rail import Array

# The measurement grid of EN 15461, in sleeper spacings from x0.
GRID_IN_BAYS = np.array([
    0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0,
    10.0, 12.0, 16.0, 20.0, 24.0, 30.0, 36.0, 42.0, 48.0, 54.0, 66.0])
NOMINAL = np.array([100.0, 125.0, 160.0, 200.0, 250.0, 315.0, 400.0, 500.0, 630.0, 800.0, 1000.0,
                    1250.0, 1600.0, 2000.0, 2500.0, 3150.0, 4000.0, 5000.0])
CENTRES = 10.0 ** (np.arange(20, 38) / 10.0)  # exact centre frequencies of the nominal ones [Hz]
HALF_BAND = 10.0**0.05  # edge over centre
LINES_PER_BAND = 60
DECAY = 10.0 / math.log(10.0)  # 4.343: dB of a decay of energy by exp(-1)

# Lower limit of ISO 3095:2013 figure 3, vertical, for the nominal bands from 250 Hz on [dB/m].
LIMIT_FROM = 250.0
LIMIT = np.array([2.0, 2.0, 6.0, 6.0, 6.0, 2.19, *[0.8] * 8])


@dataclass(frozen=True)
class DecayRate:
    """Decay rates of the nominal one-third octaves.

    frequency (18,) Hz, rate (18,) dB/m, floor: the least rate [dB/m] the grid can tell.
    """

    frequency: Array
    rate: Array
    floor: float


def track_decay_rate(
    track: Track, from_midspan: bool = True, progress: Callable[[int], object] | None = None,
) -> DecayRate:
    """Find the decay rate of the exact infinite track, 100 to 5000 Hz.

    x0 is at mid-span, as EN 15461 has it, or above a sleeper; progress is called with the number
    of frequencies just done.
    """
    lines = np.concatenate([
        np.linspace(c / HALF_BAND, c * HALF_BAND, LINES_PER_BAND + 1)[:-1]
        + 0.5 * c * (HALF_BAND - 1.0 / HALF_BAND) / LINES_PER_BAND for c in CENTRES])
    spacing = track.support.spacing
    x0 = 0.5 * spacing if from_midspan else 0.0
    distance = GRID_IN_BAYS * spacing
    h = receptances(track, lines, [x0 + float(d) for d in distance], x0, progress=progress)
    accelerance = (2.0 * math.pi * lines) ** 2 * np.abs(h)
    bands = (accelerance**2).reshape(distance.size, CENTRES.size, LINES_PER_BAND).mean(axis=2)
    return DecayRate(NOMINAL.copy(), decay_rate(distance, bands), DECAY / float(distance[-1]))


def decay_rate(distance: ArrayLike, squared: ArrayLike) -> Array:
    """Reduce to a decay rate (bands,) [dB/m] the mean squared accelerances after EN 15461.

    distance: (n,) metres from x0, ascending from 0; squared: (n, bands), in any unit.  Each
    position stands for the rail up to half-way to its neighbours; the last one, as far beyond
    itself as before.
    """
    x = np.asarray(distance, dtype=float)
    level = np.asarray(squared, dtype=float)
    half = 0.5 * np.diff(x)
    length = np.concatenate([[0.0], half]) + np.concatenate([half, half[-1:]])
    result: Array = DECAY / (length @ (level / level[0]))
    return result


def below_limit(result: DecayRate) -> Array:
    """Return the nominal frequencies [Hz] whose rate misses the lower limit of ISO 3095:2013."""
    limited = result.frequency >= LIMIT_FROM
    return result.frequency[limited][result.rate[limited] < LIMIT]
