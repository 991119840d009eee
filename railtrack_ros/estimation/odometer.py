"""Speed and track position at every sample, from speed messages and position references.

Which messages a block uses depends on their stamps alone, so that a stream and its recording give
the same numbers: those stamped up to the end of the block minus `delay`. The speed is linear
through them and extrapolated from the last two. A message that comes after a block that it should
have served is late: it is counted and has no effect.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.estimation.notes import Kind, Note
from railtrack_ros.estimation.timeline import CLOCK_RESET, SECOND

Array = NDArray[np.float64]

# Faster than any train has run [m/s]: a message beyond it is wrong.
FASTEST = 200.0

# Speed messages kept while no acceleration comes.
MOST_WAITING = 20_000

# A position reference may be this old when it comes [s].
MEMORY = 60.0

# A correction of the position moves the sleepers under the wheels by this share of the distance
# run, not at once: a jump of a wheel load along the rail would be a blow to the model.
GLIDE = 0.05


@dataclass(frozen=True)
class Run:
    """A block's way, (n,) each.

    speed [m/s]; position [m] of the vehicle's reference point; place [m]: the same but for whole
    sleeper bays and for corrections that the sleepers are still gliding to.
    """

    speed: Array
    position: Array
    place: Array


class Odometer:
    """Integrates the speed from a start position and takes corrections.

    Parameters
    ----------
    start_position
        Track position at the first sample [m].
    delay, timeout
        Settings speed_delay and speed_timeout [s].
    bay
        Sleeper spacing [m].

    Attributes
    ----------
    received, late, refused
        Numbers of speed messages that came at all, too late, and with no plausible speed.
    corrections
        Number of position references that were used.
    state
        'none' before the first usable speed, 'ok', or 'silent'.
    notes
        One-line remarks; whoever reads them clears them.
    """

    def __init__(self, start_position: float, delay: float, timeout: float, bay: float) -> None:
        self.timeout = timeout
        self.bay = bay
        self.received = self.late = self.refused = self.corrections = 0
        self.notes: deque[Note] = deque(maxlen=1000)
        self._start_position = start_position
        self._delay_ns = round(delay * SECOND)
        self._timeout_ns = round(timeout * SECOND)
        self._earlier: deque[tuple[int, float]] = deque(maxlen=1000)
        self._begin()

    def _begin(self) -> None:
        self.state = 'none'
        self._stamps: list[int] = []
        self._speeds: list[float] = []
        self._used_ns: int | None = None  # blocks have used the messages up to here
        # The last sample whose distance is known; before the first block that is moved: the first.
        self._anchor_ns: int | None = None
        self._moving = False
        self._distance = self._start_position
        self._speed = 0.0
        self._history: deque[tuple[int, float]] = deque()
        self._references: list[tuple[int, float]] = []
        self._reference_ns: int | None = None
        self._correction = 0.0
        # What the wheels' place on the sleepers leaves out of the correction: gliding, whole bays.
        self._lag = 0.0
        self._bays = 0.0

    def rewind(self, start_ns: int) -> None:
        """Begin anew at the start position, taken on when the clock was set back to start_ns."""
        earlier = sorted(x for x in self._earlier if abs(x[0] - start_ns) < CLOCK_RESET * SECOND)
        self._earlier.clear()
        self._begin()
        self._anchor_ns = start_ns
        for stamp_ns, speed in earlier:
            self._insert(stamp_ns, speed)

    # Messages in

    def add_speed(self, stamp_ns: int, speed: float) -> None:
        """Take a speed message [m/s]; messages may come in any order."""
        self.received += 1
        if not abs(speed) <= FASTEST:
            self.refused += 1
            if _now_and_then(self.refused):
                self.notes.append(Note(f'speed of {speed:g} m/s not used: no plausible speed'))
        elif self._used_ns is not None and stamp_ns <= self._used_ns:
            self._take_late(stamp_ns, speed)
        else:
            self._insert(stamp_ns, speed)
            if len(self._stamps) > MOST_WAITING:
                self._forget(MOST_WAITING // 2)

    def _take_late(self, stamp_ns: int, speed: float) -> None:
        self.late += 1
        late = ((self._used_ns or 0) - stamp_ns) / SECOND
        if late > CLOCK_RESET:
            self._earlier.append((stamp_ns, speed))
        if _now_and_then(self.late):
            self.notes.append(Note(
                f'speed message {late:.3f} s too late and not used ({self.late} so far): '
                'a larger speed_delay would give them time', Kind.NORMAL))

    def _insert(self, stamp_ns: int, speed: float) -> None:
        i = bisect_left(self._stamps, stamp_ns)
        if i == len(self._stamps) or self._stamps[i] != stamp_ns:
            self._stamps.insert(i, stamp_ns)
            self._speeds.insert(i, float(speed))

    def _forget(self, count: int) -> None:
        """Drop the oldest messages and keep the distance that they stand for."""
        time_ns = self._stamps[count]
        if self._anchor_ns is not None and time_ns > self._anchor_ns:
            self._distance += self._between(self._anchor_ns, time_ns, count + 1)
            self._anchor_ns = self._used_ns = time_ns
        del self._stamps[: count - 1], self._speeds[: count - 1]

    def set_position(self, stamp_ns: int, position: float) -> None:
        """Take the track position [m] of the reference point at a time.

        It counts from the first sample at or after its stamp in the blocks that end `delay`
        later, or from the next block on. It moves positions; distances are as before.
        """
        if not abs(position) <= 1e9:
            self.notes.append(Note(f'track position of {position:g} m not used: not plausible'))
            return
        self._references.append((stamp_ns, float(position)))
        self._references.sort()

    # Blocks

    def run(self, stamp_ns: int, t: Array, step: float, continued: bool) -> Run | None:
        """Return speed and position at the samples of the next block.

        Across a gap the speed line is integrated; so it is from the first sample of all to the
        first block with a speed.

        Parameters
        ----------
        stamp_ns, t
            Time of the block [ns] and of its samples (n,) after that [s].
        step
            Sample period [s].
        continued
            Whether the first sample follows the last one of the block before.

        Returns
        -------
        Run or None
            None where no speed is known: `state` tells why.
        """
        start_ns = stamp_ns + round(float(t[0]) * SECOND)
        end_ns = stamp_ns + round(float(t[-1]) * SECOND)
        if self._anchor_ns is None:
            self._anchor_ns = start_ns
        self._used_ns = end_ns - self._delay_ns
        usable = bisect_right(self._stamps, self._used_ns)
        if not self._known(usable, start_ns, end_ns):
            self._moving = False
            return None

        continued = continued and self._moving
        speed = self._at(t, stamp_ns, usable)
        before = self._speed if continued else speed[0]
        increments = 0.5 * step * (np.concatenate(([before], speed[:-1])) + speed)
        if not continued:
            self._distance += self._between(self._anchor_ns, start_ns, usable)
            self._lag = self._bays = increments[0] = 0.0
        distance = np.add.accumulate(np.concatenate(([self._distance], increments)))[1:]
        self._remember(start_ns, end_ns, distance)
        position, place = self._corrected(stamp_ns, t, distance, increments, continued)

        self._distance, self._speed = float(distance[-1]), float(speed[-1])
        self._anchor_ns, self._moving = end_ns, True
        unneeded = max(usable - 2, 0)
        del self._stamps[:unneeded], self._speeds[:unneeded]
        return Run(speed, position, place)

    def _known(self, usable: int, start_ns: int, end_ns: int) -> bool:
        """Tell whether a block can be given a speed, and keep `state`."""
        if usable == 0:
            if self._stamps and self._stamps[0] - end_ns > CLOCK_RESET * SECOND:
                ahead = (self._stamps[0] - end_ns) / SECOND
                self._say_once(f'speed messages are stamped {ahead:.0f} s ahead of acceleration')
            return False
        silence = end_ns - self._stamps[usable - 1]
        if silence > self._timeout_ns:
            if self.state == 'ok':
                self.notes.append(Note(
                    f'no speed for {silence / SECOND:.2f} s: nothing is estimated', Kind.SILENCE))
            self.state = 'silent'
            return False
        if self.state == 'none' and self._stamps[0] - (self._anchor_ns or 0) > self._timeout_ns:
            wait = (self._stamps[0] - (self._anchor_ns or 0)) / SECOND
            self.notes.append(Note(
                f'first speed {wait:.2f} s after the first sample: the start position is taken '
                'to be where the speed is first known'))
            self._anchor_ns = start_ns
        elif self.state == 'silent':
            self.notes.append(Note('the speed is back: start anew', Kind.NORMAL))
        self.state = 'ok'
        return True

    def _say_once(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(Note(note))

    def _at(self, t: Array, reference_ns: int, count: int) -> Array:
        """Speed at times t (n,) [s] after reference_ns, through the first `count` messages."""
        stamps = [stamp - reference_ns for stamp in self._stamps[:count]]
        times = np.array(stamps, dtype=float) / SECOND
        speeds = np.array(self._speeds[:count])
        speed = np.interp(t, times, speeds)
        if count > 1:
            for end, inner, beyond in ((0, 1, t < times[0]), (-1, -2, t > times[-1])):
                slope = (speeds[end] - speeds[inner]) / (times[end] - times[inner])
                speed[beyond] = speeds[end] + slope * (t[beyond] - times[end])
        return np.clip(speed, -FASTEST, FASTEST)

    def _between(self, from_ns: int, to_ns: int, count: int) -> float:
        """Distance [m] run between two times: the exact integral of the speed line."""
        low, high = sorted((from_ns, to_ns))
        inside = [stamp for stamp in self._stamps[:count] if low < stamp < high]
        times = np.array([stamp - low for stamp in (low, *inside, high)], dtype=float) / SECOND
        speeds = self._at(times, low, count)
        distance = float(np.sum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(times)))
        return distance if to_ns >= from_ns else -distance

    def begin(self, stamp_ns: int) -> None:
        """Count the start position from a time [ns], if nothing has come before."""
        if self._anchor_ns is None:
            self._anchor_ns = stamp_ns

    # Corrections

    def _remember(self, start_ns: int, end_ns: int, distance: Array) -> None:
        """Keep the distance over time for position references that come later."""
        self._history.append((start_ns, float(distance[0])))
        self._history.append((end_ns, float(distance[-1])))
        while end_ns - self._history[0][0] > MEMORY * SECOND:
            self._history.popleft()

    def _corrected(
        self, stamp_ns: int, t: Array, distance: Array, increments: Array, continued: bool
    ) -> tuple[Array, Array]:
        """Position (n,) with the corrections that are due, and place; see `Run`."""
        position = distance + self._correction
        bays = np.full(distance.size, self._bays)
        lag = _glide(self._lag, increments)
        due = bisect_right([stamp for stamp, _ in self._references], self._used_ns or 0)
        for reference_ns, reference in self._references[:due]:
            there = self._distance_at(reference_ns)
            if math.isnan(there):
                self.notes.append(Note(
                    'position reference not used: of a time without known distance'))
                continue
            if self._reference_ns is not None and reference_ns <= self._reference_ns:
                self.notes.append(Note('position reference not used: older than the last one'))
                continue
            change = reference - there - self._correction
            self._correction += change
            self._reference_ns = reference_ns
            self.corrections += 1
            first = int(np.searchsorted(t, (reference_ns - stamp_ns) / SECOND))
            position[first:] = distance[first:] + self._correction
            if first > 0 or continued:
                before = lag[first - 1] if first > 0 else self._lag
                whole = self.bay * round(change / self.bay)
                bays[first:] += whole
                lag[first:] = _glide(before + change - whole, increments[first:])
        self._references = self._references[due:]
        self._lag, self._bays = float(lag[-1]), float(bays[-1])
        return position, position - bays - lag

    def _distance_at(self, time_ns: int) -> float:
        """Distance at a time: linear between the blocks' ends, NaN where it is not known."""
        first_ns, first = self._history[0]
        if time_ns < first_ns:
            if time_ns < self._stamps[0] - self._timeout_ns:
                return math.nan
            return first + self._between(first_ns, time_ns, len(self._stamps))
        times = np.array([time - first_ns for time, _ in self._history], dtype=float)
        return float(np.interp(time_ns - first_ns, times, [d for _, d in self._history]))


def _glide(lag: float, increments: Array) -> Array:
    """Lag (n,) [m] that shrinks by a share of the distance run until it is zero."""
    if lag == 0.0:
        return np.zeros(increments.size)
    left = np.add.accumulate(np.concatenate(([abs(lag)], -GLIDE * np.abs(increments))))
    return np.copysign(np.maximum(left[1:], 0.0), lag)


def _now_and_then(count: int) -> bool:
    """Tell whether an event that keeps coming is worth a remark: the 1st, 2nd, 4th, 8th..."""
    return count & (count - 1) == 0
