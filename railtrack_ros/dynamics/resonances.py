"""Resonances of the track, found on the exact receptance and named by what moves how.

Below the pinned-pinned frequency the track is a rail on pads on sleepers on ballast: rail and
sleeper first swing together on the ballast (in-phase), then the sleepers are at rest between
both (the dip), then rail and sleeper swing against each other on the pads (out-of-phase).  At the
pinned-pinned frequency half a wave of the rail fits between two sleepers: resonance at mid-span,
antiresonance above the sleeper a little higher.  Under a wheel, its unsprung mass
swings on the track's stiffness (P2).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from railtrack_ros.dynamics.receptance import receptance, receptances
from railtrack_ros.track.description import Track
from railtrack_ros.track.exact import ComplexArray
from railtrack_ros.track.infinite import Sleeper
from railtrack_ros.track.rail import Array, pinned_pinned_frequency
from railtrack_ros.vehicle.description import Vehicle

LOWEST = 5.0  # [Hz] of the search
STEP = 1.0 / 600.0  # of the search, in pinned-pinned frequencies


@dataclass(frozen=True)
class Resonance:
    """A named maximum or minimum of a receptance.

    frequency [Hz]; magnitude: of the point receptance [m/N], for P2 of the contact force per
    irregularity [N/m].
    """

    name: str
    place: str  # 'midspan' or 'sleeper'
    frequency: float
    magnitude: float


def track_resonances(track: Track) -> list[Resonance]:
    """Find the resonances of the free track at mid-span and above a sleeper.

    What a track does not have (a dip too flat to be one, say) is absent.
    """
    pinned = pinned_pinned_frequency(track.rail, track.support.spacing)
    grid = np.arange(LOWEST, 1.4 * pinned, STEP * pinned)
    found: list[Resonance] = []
    for place, x in (('midspan', 0.5 * track.support.spacing), ('sleeper', 0.0)):
        rail, sleeper = receptances(track, grid, [x, Sleeper(0)], x)
        magnitude = np.abs(rail)
        together = (sleeper / rail).real > 0.0

        def of(frequency: float, x: float = x) -> float:
            return float(abs(receptance(track, [frequency], x)[0]))

        def add(name: str, index: int | None, sign: float,
                place: str = place, of: Callable[[float], float] = of) -> None:
            if index is not None:
                frequency = _refine(of, grid[index - 1], grid[index + 1], sign)
                found.append(Resonance(name, place, frequency, of(frequency)))

        peaks, dips = _extremes(magnitude), _extremes(-magnitude)
        low = grid < 0.92 * pinned
        in_phase = _largest(magnitude, [i for i in peaks if low[i] and together[i]])
        out_of_phase = _largest(magnitude, [
            i for i in peaks if low[i] and not together[i] and i > (in_phase or 0)])
        dip = _largest(-magnitude, [
            i for i in dips if (in_phase or 0) < i < (out_of_phase or len(grid)) and low[i]])
        add('in-phase', in_phase, 1.0)
        add('dip', dip, -1.0)
        add('out-of-phase', out_of_phase, 1.0)
        if place == 'midspan':
            near = np.abs(grid / pinned - 1.0) < 0.12
            add('pinned-pinned', _largest(magnitude, [i for i in peaks if near[i]]), 1.0)
        else:
            above = (grid > 0.97 * pinned) & (grid < 1.3 * pinned)
            add('pinned-pinned antiresonance',
                _largest(-magnitude, [i for i in dips if above[i]]), -1.0)
    return found


def contact_stiffness(vehicle: Vehicle) -> float:
    """Return the tangent stiffness [N/m] of the contact spring under the static load.

    For F = K d^n it is n K^(1/n) W^(1 - 1/n).
    """
    k, n = vehicle.contact.stiffness, vehicle.contact.exponent
    return n * k ** (1.0 / n) * vehicle.wheel.static_load ** (1.0 - 1.0 / n)


def force_per_irregularity(track: Track, vehicle: Vehicle, frequencies: ArrayLike, x: float
                           ) -> ComplexArray:
    """Contact force per irregularity (f,) [N/m] of one wheel standing at x [m], linearised.

    Wheel, contact spring and rail are compliances in a row: 1 / (1/kc + H - 1/(M omega^2)).
    """
    omega = 2.0 * math.pi * np.asarray(frequencies, dtype=float)
    wheel = -1.0 / (vehicle.wheel.mass * omega**2)
    rail = receptance(track, frequencies, x)
    return 1.0 / (1.0 / contact_stiffness(vehicle) + rail + wheel)


def p2_resonances(track: Track, vehicle: Vehicle) -> list[Resonance]:
    """Find P2, the first peak of the contact force per irregularity, mid-span and above a sleeper.

    The unsprung mass swings on the track; wheel modes and suspension are left out.
    """
    grid = np.geomspace(LOWEST, 400.0, 400)
    found = []
    for place, x in (('midspan', 0.5 * track.support.spacing), ('sleeper', 0.0)):
        def of(frequency: float, x: float = x) -> float:
            return float(abs(force_per_irregularity(
                track, vehicle, [frequency], x)[0]))

        peaks = _extremes(np.abs(force_per_irregularity(track, vehicle, grid, x)))
        if peaks:
            frequency = _refine(of, grid[peaks[0] - 1], grid[peaks[0] + 1], 1.0)
            found.append(Resonance('P2', place, frequency, of(frequency)))
    return found


def _extremes(values: Array) -> list[int]:
    """Return the indices of the local maxima inside values (n,)."""
    inner = values[1:-1]
    return [int(i) + 1 for i in np.flatnonzero((inner > values[:-2]) & (inner >= values[2:]))]


def _largest(values: Array, indices: list[int]) -> int | None:
    """Return the index with the largest value, None without any."""
    return max(indices, key=lambda i: values[i]) if indices else None


def _refine(of: Callable[[float], float], low: float, high: float, sign: float) -> float:
    """Return the frequency between low and high where sign * log of(frequency) is largest."""
    result = minimize_scalar(lambda f: -sign * math.log(of(f)), bounds=(low, high),
                             method='bounded', options={'xatol': 1e-6 * high})
    return float(result.x)
