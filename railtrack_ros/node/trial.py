"""A trial of an estimator before the first block comes, so that compiling delays no real one."""

from __future__ import annotations

import copy

import numpy as np

from railtrack_ros.bags.codec import SECOND
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.runs.results import ResultMessages
from railtrack_ros.vehicle.description import Vehicle

# Speed [m/s] of the trial, and its blocks of 10 ms.
SPEED = 40.0
BLOCKS = 120


def try_out(estimator: Estimator, results: ResultMessages, vehicle: Vehicle,
            sample_rate: float) -> None:
    """Run copies until the first test of the model, so that compiling delays no real block."""
    # The model of the track is shared: what it remembers of the trial serves the stream.
    model = estimator._modes
    estimator, results = copy.deepcopy(estimator, {id(model): model}), copy.deepcopy(results)
    t = np.arange(max(round(sample_rate / 100.0), 1)) / sample_rate
    channels = {box.name: np.zeros(t.size) for box in vehicle.axle_boxes}
    for index in range(-10, BLOCKS):
        stamp_ns = index * SECOND // 100
        estimator.add_speed(stamp_ns, SPEED)
        if index < 0:
            continue
        estimate = estimator.process(stamp_ns, t, channels)
        if estimate is not None:
            list(results.block(estimate, ''))
