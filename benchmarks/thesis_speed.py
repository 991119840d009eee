"""The thesis' claim of speed: convolution against direct integration, the same two cases.

Table 3.1 on concentrated supports, smooth rail, 24 m/s, steps of 25 us, 61 bays: static local
system with 6 elements a bay, dynamic one with 4. The impulse responses are computed beforehand, as
the thesis counts. Direct integration is measured twice: as (2.26) to (2.31) have it, matrices
assembled and factorised in every iteration (plain_newmark), and as the full model does it.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from measuring import Figure
from plain_newmark import PlainModel

from railtrack_ros.dynamics.irf import IrfForward
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

TITLE = "the thesis' claim of speed, microseconds a time step"

SPEED = 24.0  # m/s
STEP = 25e-6  # s
MARGIN = 30  # bays on either side: 62 in all


def figures() -> Iterator[Figure]:
    """Measure; each figure is yielded as soon as it is known."""
    static, dynamic = _bay(6, 'static'), _bay(4, 'dynamic')
    vehicle = load_vehicle('blanco_table_3_1')

    def fast(make: Any, bay: Bay, **options: Any) -> float:
        return _microseconds(make(bay, vehicle, (0.0,), STEP, 0.0, **options), 400, 20)

    yield Figure('plain direct integration, static local system',
                 _microseconds(_plain(static), 1, 40), 'us/step')
    yield Figure('plain direct integration, dynamic local system',
                 _microseconds(_plain(dynamic), 1, 30), 'us/step')
    yield Figure('full model, static local system', fast(FullModel, static, margin=MARGIN),
                 'us/step')
    yield Figure('full model, dynamic local system', fast(FullModel, dynamic, margin=MARGIN),
                 'us/step')
    yield Figure('convolution (4.4), static local system', fast(IrfForward, static), 'us/step')
    yield Figure('convolution (4.4), dynamic local system',
                 _microseconds(IrfForward(dynamic, vehicle, (0.0,), STEP, 0.0), 100, 5), 'us/step')
    yield Figure('recursion, static local system', fast(RecursiveForward, static), 'us/step')
    yield Figure('recursion, dynamic local system', fast(RecursiveForward, dynamic), 'us/step')


def measure() -> dict[str, float]:
    """Return all figures by name."""
    return {figure.name: figure.value for figure in figures()}


def _bay(elements: int, local_system: str) -> Bay:
    track = load_track('blanco_table_3_1')
    support = dataclasses.replace(track.support, kind='concentrated')
    return make_bay(dataclasses.replace(track, support=support),
                    Mesh(elements, local_system=local_system))


def _plain(bay: Bay) -> PlainModel:
    return PlainModel(bay, load_vehicle('blanco_table_3_1'), (0.0,), STEP, -MARGIN,
                      2 * MARGIN + 1)


def _microseconds(model: Any, steps: int, repeats: int) -> float:
    """Processor time of a step, the best of several repeats, after some to warm up."""
    position = SPEED * STEP * np.arange(steps * (repeats + 1))
    smooth = np.zeros((position.size, 1))
    model.run(position[:steps], smooth[:steps])
    taken = []
    for begin in range(steps, position.size, steps):
        begun = time.thread_time()
        model.run(position[begin:begin + steps], smooth[begin:begin + steps])
        taken.append(time.thread_time() - begun)
    return 1e6 * min(taken) / steps
