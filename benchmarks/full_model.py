"""Speed of the full Newmark model, and of the plain implementation of the same equations.

Table 3.1 on ISO 3095 roughness, one thread, the shortest of several repeats.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from measuring import Figure, best_time
from plain_newmark import PlainModel

from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import PadNonlinearity, load_track
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import load_vehicle

TITLE = 'full Newmark model'

SPEED = 40.0  # m/s
STEP = 50e-6  # s
STEPS = 500  # in one measurement: short, so that the best one is undisturbed by other work
REPEATS = 80
FOUR_WHEELS = (0.0, -2.5, -9.0, -11.5)


def figures() -> Iterator[Figure]:
    """Measure; each figure is yielded as soon as it is known."""
    one_wheel = _microseconds(_bay('concentrated', 6), margin=30)
    yield Figure('concentrated, 62 bays x 6 elements, 1 wheel', one_wheel, 'us/step', at_most=12.0)
    yield Figure('the same at 50 us steps', 1e6 * STEP / one_wheel, 'times real time',
                 at_least=4.0)
    distributed = _microseconds(_bay('distributed', 6), margin=30)
    yield Figure('distributed, 62 bays x 6 elements, 1 wheel', distributed, 'us/step',
                 at_most=12.0)
    yield Figure('distributed, 62 bays x 6 elements, 4 wheels',
                 _microseconds(_bay('distributed', 6), FOUR_WHEELS, margin=20), 'us/step')
    yield Figure('concentrated, 62 bays x 4 elements, dynamic local system, 1 wheel',
                 _microseconds(_bay('concentrated', 4, 'dynamic'), margin=30), 'us/step')
    for margin in (60, 120):
        yield Figure(f'concentrated, {2 * margin + 2} bays x 6 elements, 1 wheel',
                     _microseconds(_bay('concentrated', 6), margin=margin), 'us/step')
    yield Figure('the first on uneven track: every fifth sleeper softer',
                 _microseconds(_uneven(), margin=30), 'us/step')
    yield Figure('the first with progressive rail pads',
                 _microseconds(_progressive(), margin=30), 'us/step')
    plain = _plain_microseconds(_bay('concentrated', 6))
    yield Figure('plain implementation, 61 bays x 6 elements, 1 wheel', plain, 'us/step')
    yield Figure('full model against the plain implementation', plain / one_wheel, 'times faster',
                 at_least=200.0)
    yield Figure('1 km at 40 m/s, 4 wheels, 25 us steps, mainline track of 8 elements a bay',
                 _kilometre(), 's', at_most=60.0)


def _bay(kind: str, elements: int, local: str = 'static') -> Bay:
    track = load_track('blanco_table_3_1')
    support = dataclasses.replace(track.support, kind=kind)
    return make_bay(dataclasses.replace(track, support=support),
                    Mesh(elements_per_bay=elements, local_system=local))


def _uneven() -> BayRow:
    track = _bay('concentrated', 6).track
    soft = dataclasses.replace(track.support, ballast_stiffness=30e6)
    return BayRow(dataclasses.replace(track, sleepers=tuple(
        (index, soft) for index in range(-50, 200, 5))), Mesh(elements_per_bay=6))


def _progressive() -> BayRow:
    track = _bay('concentrated', 6).track
    support = dataclasses.replace(track.support, pad_nonlinearity=PadNonlinearity(20e3, 120e6))
    return BayRow(dataclasses.replace(track, support=support), Mesh(elements_per_bay=6))


def _run(offsets: Sequence[float], steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and irregularity of a run."""
    position = SPEED * STEP * np.arange(steps)
    roughness = iso3095(SPEED * STEP * steps + 14.0, seed=1, start=-13.0)
    return position, roughness.at(position[:, None] + np.asarray(offsets))


def _microseconds(bay: Bay | BayRow, offsets: Sequence[float] = (0.0,), margin: int = 30) -> float:
    position, irregularity = _run(offsets, (REPEATS + 1) * STEPS)
    model = FullModel(bay, load_vehicle('blanco_table_3_1'), offsets, STEP, 0.0, margin=margin)
    model.run(position[:10], irregularity[:10])  # compiled, caches warm
    parts = iter(range(10, REPEATS * STEPS + 10, STEPS))

    def step() -> None:
        begin = next(parts)
        model.run(position[begin:begin + STEPS], irregularity[begin:begin + STEPS])

    return 1e6 * best_time(step, REPEATS) / STEPS


def _plain_microseconds(bay: Bay, steps: int = 4, repeats: int = 15) -> float:
    position, irregularity = _run((0.0,), repeats * steps + 2)
    model = PlainModel(bay, load_vehicle('blanco_table_3_1'), (0.0,), STEP, -30, 61)
    model.run(position[:2], irregularity[:2])
    parts = iter(range(2, repeats * steps + 2, steps))

    def step() -> None:
        begin = next(parts)
        model.run(position[begin:begin + steps], irregularity[begin:begin + steps])

    return 1e6 * best_time(step, repeats) / steps


def _kilometre() -> float:
    vehicle = load_vehicle('measurement_coach')
    offsets = [box.offset for box in vehicle.on_rail('left')]
    model = FullModel(make_bay(load_track('mainline_soft_pads')), vehicle, offsets, 25e-6, 0.0)
    roughness = iso3095(100.0, seed=1, start=0.0)
    position = 40.0 * 25e-6 * np.arange(1_000_000)
    model.run(position[:10], np.zeros((10, 4)))
    wanted = [slice(begin, begin + 50_000) for begin in range(10, position.size, 50_000)]

    def drive() -> None:
        for part in wanted:
            places = position[part, None] + np.asarray(offsets)
            model.run(position[part], roughness.at(np.mod(places, 100.0)))

    return best_time(drive, 1)
