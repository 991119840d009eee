"""The full model under irregularity that was recovered from measured acceleration.

The wheels of a vehicle run over the finite-element track, each over its own irregularity as it was
sampled in time, and answer on the same samples: ready to be held against the measurement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from railtrack_ros.bags.signals import Decimator
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.track.bay import Bay
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

# Newmark stretches periods by (omega dt)^2 / 12: 1.3 % at 2.5 kHz.
LONGEST_STEP = 25e-6
CHUNK = 0.1            # s of running between two looks at the clock
PADDING = 32           # samples around a chunk that its interpolation looks at
QUANTITIES = ('contact_force', 'rail_deflection', 'axle_box_acceleration')


def oversampling(time_step: float, longest_step: float) -> int:
    """Return the model's time steps per sample period [s].

    Two at least, so that the model's answer is filtered before it is sampled.
    """
    return max(2, math.ceil(time_step / longest_step * (1.0 - 1e-9)))


class DrivenModel:
    """The wheels of one rail, fed with sampled irregularity, chunk after chunk."""

    def __init__(self, bay: Bay | BayRow, vehicle: Vehicle, rail: str, start_position: float,
                 time_step: float, longest_step: float = LONGEST_STEP) -> None:
        """Take a sample period [s]; the model's own step is a whole fraction of it."""
        self.boxes = vehicle.on_rail(rail)
        self.factor = oversampling(time_step, longest_step)
        self.model = FullModel(bay, vehicle, [box.offset for box in self.boxes],
                               time_step / self.factor, start_position)
        self._decimators = [Decimator(self.factor) for _ in QUANTITIES]

    def run(self, position: Array, irregularity: Array, begin: int, end: int) -> list[Array]:
        """Drive from sample begin to end of a run of positions (n,) and irregularity (n, wheels).

        Returns the samples (m, wheels) of each of `QUANTITIES` that this completes, delayed by
        the reach of the anti-aliasing filter but in phase.
        """
        steps = (end - begin) * self.factor if end < position.size else (
            (end - begin - 1) * self.factor + 1)
        low, high = max(0, begin - PADDING), min(position.size, end + PADDING)
        fine = signal.resample_poly(irregularity[low:high], self.factor, 1, axis=0)
        fine = fine[(begin - low) * self.factor:][:steps]
        places = np.interp(begin + np.arange(steps) / self.factor,
                           np.arange(low, high), position[low:high])
        result = self.model.run(places, fine)
        return [decimator.process(getattr(result, quantity))
                for decimator, quantity in zip(self._decimators, QUANTITIES, strict=True)]


def drive(bay: Bay | BayRow, vehicle: Vehicle, position: Array, irregularity: Mapping[str, Array],
          time_step: float, longest_step: float = LONGEST_STEP,
          progress: Callable[[float], None] = lambda share: None
          ) -> dict[str, dict[str, Array]]:
    """Drive the full model, both rails side by side.

    Parameters
    ----------
    bay
        A periodic linear track's bay, or the row of bays of any track.
    position
        (n,) track position of the vehicle's reference point [m].
    irregularity
        By axle box, (n,) [m] at the axle box's own place; finite, and zero at the first sample
        (which is the static equilibrium).
    time_step, longest_step
        Sample period and upper bound of the model's own time step [s].
    progress
        Called with the share of the run that is done.

    Returns
    -------
    dict
        Quantity of `QUANTITIES` -> axle box -> (n,); NaN in the last samples, which the
        anti-aliasing filter cannot complete.
    """
    n = position.size
    rails = [DrivenModel(bay, vehicle, rail, float(position[0]), time_step, longest_step)
             for rail in vehicle.rails]
    excitation = [np.column_stack([irregularity[box.name] for box in rail.boxes])
                  for rail in rails]
    found: dict[str, dict[str, Array]] = {
        quantity: {box.name: np.full(n, np.nan) for box in vehicle.axle_boxes}
        for quantity in QUANTITIES}
    chunk = max(1, round(CHUNK / time_step))
    done = 0
    with ThreadPoolExecutor(len(rails)) as pool:
        for begin in range(0, n, chunk):
            end = min(begin + chunk, n)
            new = list(pool.map(lambda pair, a=begin, b=end: pair[0].run(position, pair[1], a, b),
                                zip(rails, excitation, strict=True)))
            for rail, arrays in zip(rails, new, strict=True):
                for quantity, values in zip(QUANTITIES, arrays, strict=True):
                    for wheel, box in enumerate(rail.boxes):
                        found[quantity][box.name][done:done + len(values)] = values[:, wheel]
            done += len(new[0][0])
            progress(end / n)
    return found
