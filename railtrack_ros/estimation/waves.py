"""Statistics of one band's signal along a section: moving RMS, peak-to-peak values, impacts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.estimation.limits import BandLimit

Array = NDArray[np.float64]

# An impact sticks out of its surroundings by this many standard deviations (told by the median,
# which impacts do not move), by so many metres at least, and is over within this length [m].
IMPACT_HEIGHT = 7.0
IMPACT_LEAST = 3e-6
IMPACT_LENGTH = 0.6

# At most this share of a section is impact: more is irregularity.
IMPACT_SHARE = 0.08

# What is largest this close to an end [m] belongs to the neighbour: corrugation that begins there.
IMPACT_EDGE = 0.06

# The median is that of every so-many-th point.
MEDIAN_OF_EVERY = 4

NORMAL_MEDIAN = 0.6744897501960817  # of |x| of a standard normal x


@njit(cache=True, nogil=True)
def square_sum(values):
    """Return the number of valid values (n,), and the sum of their squares."""
    count, total = 0, 0.0
    for value in values:
        if value == value:
            count += 1
            total += value * value
    return count, total


@njit(cache=True, nogil=True)
def peak_to_peaks(values, step):
    """Return places and heights (k,) of the rises and falls between neighbouring extremes.

    values (n,), `step` [m] apart, NaN where not valid. Each extreme is that of the parabola
    through three points; a place is the middle between two of them, from the first point on.
    """
    places, heights = np.empty(values.size), np.empty(values.size)
    count, last_place, last = 0, 0.0, np.nan
    for n in range(1, values.size - 1):
        a, b, c = values[n - 1], values[n], values[n + 1]
        if a != a or b != b or c != c:
            last = np.nan
            continue
        if (b > a and b >= c) or (b < a and b <= c):
            bend = a - 2.0 * b + c
            off = 0.5 * (a - c) / bend
            extreme, place = b - 0.25 * (a - c) * off, (n + off) * step
            if last == last:
                places[count], heights[count] = 0.5 * (place + last_place), abs(extreme - last)
                count += 1
            last, last_place = extreme, place
    return places[:count], heights[:count]


@njit(cache=True, nogil=True)
def moving_mean(places, values, length, window, step):
    """Means (m,) of values (n,) at places (n,) within a window moved by step over 0 ... length.

    A window longer than the stretch is the whole stretch; an empty one gives NaN.
    """
    window = min(window, length)
    count = int((length - window) / step + 1e-9) + 1
    means = np.empty(count)
    total, first, after = 0.0, 0, 0
    for m in range(count):
        begin = m * step
        while after < places.size and places[after] <= begin + window:
            total += values[after]
            after += 1
        while first < after and places[first] < begin:
            total -= values[first]
            first += 1
        means[m] = total / (after - first) if after > first else np.nan
    return means


@njit(cache=True, nogil=True)
def share_of_rms_above(values, window, limit):
    """Return which share of all stretches of `window` points has an RMS above a limit.

    values (n,), NaN where not valid; stretches that are less than half valid do not count, and
    without any other the share is NaN.
    """
    window = max(1, min(window, values.size))
    total, valid, stretches, beyond = 0.0, 0, 0, 0
    for n in range(values.size):
        if values[n] == values[n]:
            total += values[n] * values[n]
            valid += 1
        if n >= window and values[n - window] == values[n - window]:
            total -= values[n - window] * values[n - window]
            valid -= 1
        if n >= window - 1 and 2 * valid >= window:
            stretches += 1
            if total > limit * limit * valid:
                beyond += 1
    return beyond / stretches if stretches else np.nan


def largest_mean_peak_to_peak(values: Array, step: float, window: float) -> float:
    """Return the largest moving average of peak-to-peak values, NaN without any.

    values (n,) [m] of a band, `step` apart; window [m].
    """
    places, heights = peak_to_peaks(values, step)
    return _largest(moving_mean(places, heights, values.size * step, window, 0.1 * window))


def above(values: Array, step: float, statistic: str, limit: BandLimit) -> tuple[float, float]:
    """Return which share of a section is above a limit, and the section's mean over the limit.

    Parameters
    ----------
    values
        (n,) [m] signal of the band, `step` [m] apart, NaN where not valid.
    statistic
        Of the limit: the share is one of the length for moving statistics (windows inside the
        section), of the peak-to-peak values else.

    Returns
    -------
    tuple
        Share of 0 to 1 and the ratio of the whole section's RMS, or mean peak-to-peak value, to
        the limit; NaN each without a valid value.
    """
    if statistic == 'moving_rms':
        count, squares = square_sum(values)
        if not count:
            return math.nan, math.nan
        share = share_of_rms_above(values, round(limit.window / step), limit.limit)
        return share, math.sqrt(squares / count) / limit.limit
    places, heights = peak_to_peaks(values, step)
    if not heights.size:
        return math.nan, math.nan
    each = heights
    if statistic == 'moving_peak_to_peak':
        each = moving_mean(places, heights, values.size * step, limit.window, 0.1 * limit.window)
        each = each[np.isfinite(each)]
    share = np.count_nonzero(each > limit.limit) / each.size if each.size else math.nan
    return share, float(np.mean(heights)) / limit.limit


def impacts(values: Array, step: float) -> list[float]:
    """Return the places [m from the first point] of short blows, as of joints and switches.

    values (n,) [m] of the shortest band that is resolved, `step` [m] apart, NaN where not valid.
    A corrugated stretch, however short, lasts longer than a blow.
    """
    size = np.abs(values)
    some = np.sort(size[::MEDIAN_OF_EVERY])  # NaN comes last
    valid = int(np.count_nonzero(some == some))
    if not valid:
        return []
    threshold = max(IMPACT_HEIGHT * float(some[valid // 2]) / NORMAL_MEDIAN, IMPACT_LEAST)
    high = np.flatnonzero(size > threshold)
    if not high.size:
        return []
    groups = np.split(high, np.flatnonzero(np.diff(high) * step > IMPACT_LENGTH) + 1)
    short = [group for group in groups if (group[-1] - group[0]) * step <= IMPACT_LENGTH]
    points = MEDIAN_OF_EVERY * valid
    if len(short) < len(groups) or sum(g[-1] - g[0] + 1 for g in short) > IMPACT_SHARE * points:
        return []
    places = [float(group[np.argmax(size[group])]) * step for group in short]
    return [x for x in places if IMPACT_EDGE < x < values.size * step - IMPACT_EDGE]


def _largest(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else math.nan
