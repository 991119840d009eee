"""Speed of the frequency domain: the exact infinite track, and a finite one of elements.

Table 3.1 with its distributed supports, 1000 frequencies from 2 Hz to 2 kHz, one thread.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from measuring import Figure, best_time

from railtrack_ros.dynamics.decay_rate import track_decay_rate
from railtrack_ros.dynamics.receptance import finite_track, receptance
from railtrack_ros.track.bay import Mesh
from railtrack_ros.track.description import load_track

TITLE = 'frequency domain'

FREQUENCIES = 2.0 * np.arange(1.0, 1001.0)


def figures() -> Iterator[Figure]:
    track = load_track('blanco_table_3_1')
    infinite = best_time(lambda: receptance(track, FREQUENCIES, 0.3))
    yield Figure('exact infinite track, 1000 frequencies', infinite, 's', at_most=1.0)
    finite = best_time(
        lambda: receptance(finite_track(track, Mesh(8), 100), FREQUENCIES, 0.3), repeats=3)
    yield Figure('100 bays of 8 elements, 1000 frequencies', finite, 's')
    yield Figure('track decay rate in one-third octaves, 100 Hz to 5 kHz',
                 best_time(lambda: track_decay_rate(track), repeats=3), 's')
