"""Speed of the corrugation indicators: irregularity in blocks of 10 ms, sections of 10 m out.

One thread, the shortest of several repeats; everything that a section holds is computed (RMS,
peak-to-peak values and exceedance in four bands, dominant wavelength, impacts, level).
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from measuring import Figure, best_time

from railtrack_ros.estimation.analysis import TrackAnalysis
from railtrack_ros.estimation.indicators import SectionIndicators
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.vehicle.description import AxleBox

TITLE = 'corrugation indicators'

RATE = 25600.0
SECONDS = 20.0
BLOCK = 256
REPEATS = 7


class OneChannel:
    """A vehicle with one axle box."""

    axle_boxes = (AxleBox('axle1_left', 'left', 0.0),)


class FourChannels:
    """A vehicle with four axle boxes over one rail."""

    axle_boxes = tuple(AxleBox(f'axle{n}_left', 'left', offset)
                       for n, offset in enumerate((0.0, -2.5, -19.0, -21.5), 1))


class EightChannels:
    """A vehicle with four axles, an axle box over either rail."""

    axle_boxes = (*FourChannels.axle_boxes, *(
        AxleBox(box.name.replace('left', 'right'), 'right', box.offset)
        for box in FourChannels.axle_boxes))


def figures() -> Iterator[Figure]:
    """Measure; each figure is yielded as soon as it is known."""
    for speed in (15.0, 25.0, 40.0):
        rate, _ = _live(OneChannel, speed)
        yield Figure(f'live, one channel at 25.6 kHz, {speed:g} m/s', rate, 'times real time',
                     at_least=300.0)
    rate, longest = _live(EightChannels, 25.0)
    yield Figure('live, eight channels at 25.6 kHz, 25 m/s', rate, 'times real time')
    yield Figure('its longest block, where sections are finished', 1e3 * longest, 'ms')
    yield Figure('analysis of one channel, zero-phase, 25 m/s', _analysis(OneChannel, None),
                 'times real time')
    yield Figure('analysis of four channels with their wheels set apart, 25 m/s',
                 _analysis(FourChannels, 0.46), 'times real time')


def _blocks(vehicle: type, speed: float) -> list[tuple[np.ndarray, np.ndarray, dict]]:
    """Times, positions and irregularity of a run in blocks."""
    t = np.arange(round(SECONDS * RATE)) / RATE
    position = speed * t
    rough = iso3095(speed * SECONDS + 60.0, seed=1, start=-30.0)
    data = {box.name: rough.at(position + box.offset).astype(np.float32)
            for box in vehicle.axle_boxes}
    parts = [slice(k, k + BLOCK) for k in range(0, t.size, BLOCK)]
    return [(t[part], position[part], {name: y[part] for name, y in data.items()})
            for part in parts]


def _live(vehicle: type, speed: float) -> tuple[float, float]:
    """Times real time, and the longest processor time of a block [s], both at best."""
    blocks = _blocks(vehicle, speed)
    longest = []

    def run(stream: SectionIndicators) -> None:
        worst = 0.0
        for block in blocks:
            begun = time.thread_time()  # what others take is not counted
            stream.feed(*block)
            worst = max(worst, time.thread_time() - begun)
        stream.finish()
        longest.append(worst)

    run(SectionIndicators(vehicle))  # compiled
    streams = iter([SectionIndicators(vehicle) for _ in range(REPEATS)])
    seconds = best_time(lambda: run(next(streams)), REPEATS)
    return SECONDS / seconds, min(longest[1:])


def _analysis(vehicle: type, radius: float | None) -> float:
    blocks = _blocks(vehicle, 25.0)

    def run() -> None:
        analysis = TrackAnalysis(vehicle, wheel_radius=radius)
        for block in blocks:
            analysis.feed(*block)
        analysis.finish()

    run()
    return SECONDS / best_time(run, 2)
