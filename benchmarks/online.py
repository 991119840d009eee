"""Speed of the online solver: forward, inverse, precomputation, and against the full models.

Table 3.1 on distributed supports, ISO 3095 roughness at 40 m/s, one thread, the shortest of
several repeats.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from measuring import Figure, best_time
from plain_newmark import PlainModel

from railtrack_ros.compiled import cache_base
from railtrack_ros.dynamics import cache
from railtrack_ros.dynamics.irf import IrfForward
from railtrack_ros.dynamics.modes import make_track_modes, ring_length
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import MAXIMUM_FREQUENCY, RecursiveForward
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.track.bay import make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

TITLE = 'online solver'

TRACK, VEHICLE = 'blanco_table_3_1', 'blanco_table_3_1'
SPEED = 40.0  # m/s
STEP = 50e-6  # s
STEPS = 500  # in one measurement: short, so that the best one is undisturbed by other work
REPEATS = 60
FOUR_WHEELS = (0.0, -2.5, -9.0, -11.5)
RATE = 25600.0  # Hz, of the inverse
NANOSECONDS = 10**9

FIRST_RESULT = """
import numpy as np
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle
estimator = Estimator(load_track('blanco_table_3_1'), load_vehicle('measurement_coach'))
estimator.add_speed(0, 40.0)
names = [box.name for box in estimator.vehicle.axle_boxes]
t = np.arange(12800) / 25600.0
block = estimator.process(0, t, {name: np.zeros(t.size) for name in names})
assert np.isfinite(block.irregularity[names[0]][-1])
with open('/proc/self/status') as file:
    print(*(int(line.split()[1]) / 1e3 for line in file if line.startswith('VmHWM')))
"""


def figures() -> Iterator[Figure]:
    """Measure; each figure is yielded as soon as it is known."""
    bay = make_bay(load_track(TRACK))
    one, full = (_forward(kind, bay, (0.0,)) for kind in (RecursiveForward, FullModel))
    yield Figure('forward, 1 wheel', one, 'us/step', at_most=1.0)
    yield Figure('the same at 20 kHz', 1e6 * STEP / one, 'times real time', at_least=50.0)
    four = _forward(RecursiveForward, bay, FOUR_WHEELS)
    yield Figure('forward, 4 wheels on a rail', four, 'us/step', at_most=2.0)
    yield Figure('forward, 1 wheel, against our own full model', full / one, 'times faster',
                 at_least=8.0)
    yield Figure('forward, 4 wheels, against our own full model',
                 _forward(FullModel, bay, FOUR_WHEELS) / four, 'times faster', at_least=8.0)
    yield Figure('forward, 1 wheel, against the plain sparse implementation',
                 _plain(bay) / one, 'times faster', at_least=100.0)
    yield Figure('convolution, memory 0.1 s, 1 wheel', _forward(IrfForward, bay, (0.0,), 12),
                 'us/step')
    for track in (TRACK, 'mainline_soft_pads'):
        yield Figure(f'inverse, 8 axle boxes at 25.6 kHz, {track}', _inverse(track),
                     'times real time', at_least=12.0)
    with _fresh_cache():
        bays = ring_length(bay, list(FOUR_WHEELS))
        for name, limit in (('precomputation of modes', 10.0), ('the same from the cache', 0.2)):
            begun = time.perf_counter()
            make_track_modes(bay, bays, MAXIMUM_FREQUENCY)
            yield Figure(f'{name}, 4 wheels', time.perf_counter() - begun, 's', at_most=limit)
        yield Figure('entry in the cache', sum(e.size for e in cache.entries()) / 1e6, 'MB')
        first, _ = _first_result()
        later, memory = min(_first_result() for _ in range(3))
        yield Figure('compiling: first start of all less a later one', first - later, 's',
                     at_most=20.0)
        yield Figure('every later start, to the first estimate', later, 's', at_most=2.0)
        yield Figure('memory of the process that estimates', memory, 'MB', at_most=300.0)
    used = sum(entry.size for entry in cache.entries())
    yield Figure(f'cache on disk ({cache_base()})', used / 1e6, 'MB')


def _run(offsets: Sequence[float], steps: int) -> tuple[np.ndarray, np.ndarray]:
    position = SPEED * STEP * np.arange(steps)
    roughness = iso3095(SPEED * STEP * steps + 14.0, seed=1, start=-13.0)
    return position, roughness.at(position[:, None] + np.asarray(offsets))


def _microseconds(model: Any, offsets: Sequence[float], steps: int, repeats: int) -> float:
    position, irregularity = _run(offsets, repeats * steps + 10)
    model.run(position[:10], irregularity[:10])  # compiled, caches warm
    parts = iter(range(10, repeats * steps + 10, steps))

    def step() -> None:
        begin = next(parts)
        model.run(position[begin:begin + steps], irregularity[begin:begin + steps])

    return 1e6 * best_time(step, repeats) / steps


def _forward(kind: Callable[..., Any], bay: Any, offsets: Sequence[float],
             repeats: int = REPEATS) -> float:
    model = kind(bay, load_vehicle(VEHICLE), offsets, STEP, 0.0)
    return _microseconds(model, offsets, STEPS, repeats)


def _plain(bay: Any) -> float:
    model = PlainModel(bay, load_vehicle(VEHICLE), (0.0,), STEP, -30, 61)
    return _microseconds(model, (0.0,), 4, 5)


def _inverse(track: str) -> float:
    """Blocks of 20 ms of noise through the estimator."""
    estimator = Estimator(load_track(track), load_vehicle('measurement_coach'))
    samples, rng = 512, np.random.default_rng(0)
    channels = {box.name: 20.0 * rng.standard_normal(samples)
                for box in estimator.vehicle.axle_boxes}
    t = np.arange(samples) / RATE
    blocks = iter(range(10**6))

    def block() -> None:
        stamp = round(next(blocks) * samples / RATE * NANOSECONDS)
        estimator.add_speed(stamp, SPEED)
        estimator.process(stamp, t, channels)

    block()
    return samples / RATE / best_time(block, 400)


@contextlib.contextmanager
def _fresh_cache() -> Iterator[None]:
    """Everything that is kept on disk is empty for once, as on the very first start."""
    before = os.environ.get('NUMBA_CACHE_DIR')
    with tempfile.TemporaryDirectory() as folder:
        os.environ['NUMBA_CACHE_DIR'] = folder
        try:
            yield
        finally:
            del os.environ['NUMBA_CACHE_DIR']
            if before is not None:
                os.environ['NUMBA_CACHE_DIR'] = before


def _first_result() -> tuple[float, float]:
    """Seconds of a process from its start to the first valid estimate, and its memory [MB]."""
    begun = time.perf_counter()
    done = subprocess.run([sys.executable, '-c', FIRST_RESULT], check=True, capture_output=True,
                          text=True)
    return time.perf_counter() - begun, float(done.stdout)
