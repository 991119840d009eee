"""Statistics of one band's signal along a section: moving RMS, peak-to-peak values, impacts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.estimation.limits import BandLimit

Array = NDArray[np.floating]

# An impact sticks out of its surroundings by this many standard deviations (told by the median,
# which impacts do not move), by so many metres at least, and is over within this length [m]. What
# is closer together than the gap [m] is one: a wheel crosses a joint, or the nose of a switch.
IMPACT_HEIGHT = 7.0
IMPACT_LEAST = 3e-6
IMPACT_LENGTH = 1.0
IMPACT_GAP = 0.6

# At most this share of a section is impact: more is irregularity.
IMPACT_SHARE = 0.08

# What reaches into a section no further than this [m] from a longer rough stretch beyond belongs to
# the neighbour: the filter's answer to corrugation that begins there.
IMPACT_EDGE = 0.06

# A blow this close to a section [m] is in its longer waves, too, and counts.
IMPACT_REACH = 0.3

# So much [m] on either side of a section is looked at: a blow that counts is seen as a whole.
IMPACT_AROUND = IMPACT_LENGTH + IMPACT_REACH

# The median is that of every so-many-th point.
MEDIAN_OF_EVERY = 4

NORMAL_MEDIAN = 0.6744897501960817  # of |x| of a standard normal x


@njit(cache=True, nogil=True, fastmath={'reassoc', 'contract'})
def square_sum(values):
    """Return the number of valid values (n,), and the sum of their squares."""
    count, total = 0, 0.0
    for n in range(values.size):
        value = np.float64(values[n])
        valid = value == value
        count += valid
        total += value * value if valid else 0.0
    return count, total


# Weights of the points half a point, one and a half and two and a half away for the value between
# two points: exact for constants and for waves of eight and of five points.
_BETWEEN = np.linalg.solve(
    2.0 * np.cos(np.pi * np.outer((0.0, 1.0 / 8.0, 1.0 / 5.0), (1.0, 3.0, 5.0))), np.ones(3))


@njit(cache=True, nogil=True)
def _between(values, n):
    """Value half a point after point n, from the six points around; NaN without them."""
    if n < 2 or n + 3 >= values.size:
        return np.nan
    return (_BETWEEN[0] * (values[n] + values[n + 1])
            + _BETWEEN[1] * (values[n - 1] + values[n + 2])
            + _BETWEEN[2] * (values[n - 2] + values[n + 3]))  # fmt: skip


@njit(cache=True, nogil=True)
def _vertex(values, n):
    """Place [points] and value of an extreme whose largest point is n.

    That of the parabola through n, the larger one of its neighbours (the smaller one of a trough)
    and the value between these two; through n and both neighbours where too few are around.
    """
    a, b, c = np.float64(values[n - 1]), np.float64(values[n]), np.float64(values[n + 1])
    before = (a > c) == (2.0 * b > a + c)
    between = _between(values, n - 1 if before else n)
    if between == between:
        end = a if before else c
        bend = b - 2.0 * between + end
        off = 0.5 * (b - end) / bend if bend != 0.0 else 0.0
        half = -0.5 if before else 0.5
        return n + half * (1.0 + off), between - 0.25 * (b - end) * off
    bend = a - 2.0 * b + c
    off = 0.5 * (a - c) / bend
    return n + off, b - 0.25 * (a - c) * off


@njit(cache=True, nogil=True)
def peak_to_peaks(values, step):
    """Return places and heights (k,) of the rises and falls between neighbouring extremes.

    values (n,), `step` [m] apart, NaN where not valid. A place is the middle between two extremes,
    from the first point on.
    """
    # Without a branch, for where the next extreme comes cannot be foretold.
    extremes = np.empty(values.size + 1, dtype=np.int64)
    found = 0
    for n in range(1, values.size - 1):
        a, b, c = values[n - 1], values[n], values[n + 1]
        extremes[found] = n
        found += ((b > a) & (b >= c)) | ((b < a) & (b <= c)) | (b != b)
    places, heights = np.empty(found), np.empty(found)
    count, last_place, last = 0, 0.0, np.nan
    for n in extremes[:found]:
        place, extreme = _vertex(values, n)
        if last == last and extreme == extreme:
            places[count], heights[count] = (
                0.5 * step * (place + last_place), abs(extreme - last))
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
        value = np.float64(values[n])
        if value == value:
            total += value * value
            valid += 1
        if n >= window:
            value = np.float64(values[n - window])
            if value == value:
                total -= value * value
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


def impacts(values: Array, step: float, before: Array | None = None, after: Array | None = None
            ) -> list[float]:
    """Return the places [m from the first point] of short blows, as of joints and switches.

    A corrugated stretch, however short, lasts longer than a blow.

    Parameters
    ----------
    values
        (n,) [m] of the shortest band that is resolved, `step` [m] apart, NaN where not valid.
    before, after
        What precedes and follows, up to `IMPACT_AROUND`: a blow beside a border is one of the
        sections on either side of it.
    """
    size = np.abs(values)
    some = np.sort(size[::MEDIAN_OF_EVERY])  # NaN comes last
    valid = int(np.count_nonzero(some == some))
    if not valid:
        return []
    threshold = max(IMPACT_HEIGHT * float(some[valid // 2]) / NORMAL_MEDIAN, IMPACT_LEAST)
    around = np.abs(np.concatenate([part for part in (before, size, after) if part is not None]))
    high = np.flatnonzero(around > threshold)
    if not high.size:
        return []
    first = 0 if before is None else len(before)
    last, reach = first + size.size, IMPACT_REACH / step
    groups = np.split(high, np.flatnonzero(np.diff(high) * step > IMPACT_GAP) + 1)
    found, points = [], 0
    for group in groups:
        inside = group[(group >= first) & (group < last)]
        if (group[-1] - group[0]) * step > IMPACT_LENGTH:
            if inside.size and (inside[-1] - inside[0]) * step > IMPACT_EDGE:
                return []
            continue
        points += inside.size
        place = int(group[np.argmax(around[group])])
        if first - reach <= place < last + reach:
            found.append((place - first) * step)
    return found if points <= IMPACT_SHARE * MEDIAN_OF_EVERY * valid else []


def _largest(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else math.nan
