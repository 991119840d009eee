"""The thesis' two tracks as it uses them, and runs of a wheel over them until they are steady."""

from __future__ import annotations

import dataclasses

import numpy as np

from railtrack_ros.dynamics.forward import ForwardResult
from railtrack_ros.dynamics.irf import IrfForward
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.figures.content import Array
from railtrack_ros.irregularity.profile import sine
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import Track, load_track
from railtrack_ros.vehicle.description import Vehicle, load_vehicle

SOLVERS = {'newmark': FullModel, 'irf': IrfForward, 'recursive': RecursiveForward}
SUPPORTS = {'CVS': 'concentrated', 'CVRS': 'concentrated_rotational', 'DS': 'distributed'}

SPEED_2_1 = 148.0 / 3.6  # m/s
SPEED_3_1 = 24.0
SPEED_CORRUGATED = 44.4
CORRUGATION = 0.041  # m

# Bays that a wheel runs before it is looked at: from rest on the track into the steady state.
RUN_UP = 20


def variant(name: str, kind: str, loss_factor: float = 0.0, **rail: float) -> Track:
    """Return a shipped track with other supports; the thesis' rails have no loss."""
    track = load_track(name)
    return dataclasses.replace(
        track, rail=dataclasses.replace(track.rail, loss_factor=loss_factor, **rail),
        support=dataclasses.replace(track.support, kind=kind))


def table_2_1(loss_factor: float = 0.0) -> Track:
    """Table 2.1 on concentrated supports."""
    return variant('blanco_table_2_1', 'concentrated', loss_factor)


def table_3_1(support: str = 'DS', loss_factor: float = 0.0) -> Track:
    """Table 3.1 on supports by the thesis' abbreviation: CVS, CVRS or DS."""
    return variant('blanco_table_3_1', SUPPORTS[support], loss_factor)


def drive(bay: Bay, vehicle: Vehicle, speed: float, first: float, last: float,
          time_step: float = 5e-6, amplitude: float = 0.0, solver: str = 'newmark',
          run_up: int = RUN_UP, **options: float) -> tuple[Array, ForwardResult]:
    """Run one wheel up to `last` [m]; returns positions (n,) from `first` on and the answers there.

    amplitude: of the corrugation of figures 3.6 and 3.7 [m], a cosine with a crest at 0 m, which
    grows over the first metre of the run-up.
    """
    start = (np.floor(first / bay.spacing) - run_up) * bay.spacing
    position = start + speed * time_step * np.arange(round((last - start) / speed / time_step) + 1)
    irregularity = sine(position + 0.25 * CORRUGATION, CORRUGATION, amplitude)
    irregularity *= np.clip(position - start, 0.0, 1.0)
    model = SOLVERS[solver](bay, vehicle, (0.0,), time_step, start, **options)
    result = model.run(position, irregularity[:, None])
    wanted = int(np.searchsorted(position, first))
    return position[wanted:], result.part(wanted, position.size)


def steady_3_1(support: str, mesh: Mesh | None = None, vehicle: Vehicle | None = None,
               **options: object) -> tuple[Array, ForwardResult]:
    """Table 3.1 at 24 m/s from 6 to 9 m, as figures 3.5 and 4.3 show it."""
    bay = make_bay(table_3_1(support), mesh or Mesh(8))
    return drive(bay, vehicle or load_vehicle('blanco_table_3_1'), SPEED_3_1, 6.0, 9.0,
                 **options)  # type: ignore[arg-type]


def thinned(x: Array, *values: Array, points: int = 1500) -> tuple[Array, ...]:
    """Every so many-th sample, so that about `points` are left."""
    every = max(1, x.size // points)
    return tuple(array[::every] for array in (x, *values))


def sleepers(spacing: float, first: float, last: float) -> tuple[float, ...]:
    """Places of the sleepers between two places [m]."""
    low, high = int(np.ceil(first / spacing - 1e-9)), int(np.floor(last / spacing + 1e-9))
    return tuple(spacing * k for k in range(low, high + 1))
