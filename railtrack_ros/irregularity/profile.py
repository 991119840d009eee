"""Irregularity as a function of the place on the track.

z points up: a positive value is a bump.  The irregularity is the combined one of rail and wheel,
as the contact sees it.  Shapes that have a formula (sine, corrugation, dipped joint) are plain
functions of x, so that any of them can be added to a sampled profile.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from railtrack_ros.errors import InputError
from railtrack_ros.irregularity.spectra import HALF_BAND, density

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Profile:
    """Irregularity (n,) [m] sampled at increasing track positions (n,) [m]."""

    position: Array
    irregularity: Array
    name: str = 'irregularity'

    def __post_init__(self) -> None:
        position = np.ascontiguousarray(self.position, dtype=float)
        irregularity = np.ascontiguousarray(self.irregularity, dtype=float)
        if position.ndim != 1 or position.shape != irregularity.shape or position.size < 2:
            raise InputError(f'{self.name}: expected at least two positions and one value at each, '
                             f'got shapes {position.shape} and {irregularity.shape}')
        if not (np.isfinite(position).all() and np.isfinite(irregularity).all()):
            raise InputError(f'{self.name}: a position or a value is not a finite number')
        if not (np.diff(position) > 0.0).all():
            first = int(np.argmin(np.diff(position) > 0.0))
            raise InputError(f'{self.name}: positions have to increase, but '
                             f'{position[first + 1]:g} m follows {position[first]:g} m')
        object.__setattr__(self, 'position', position)
        object.__setattr__(self, 'irregularity', irregularity)

    @cached_property
    def _curve(self) -> CubicSpline:
        return CubicSpline(self.position, self.irregularity)

    def at(self, x: ArrayLike) -> Array:
        """Irregularity [m] at track positions x [m], any shape, by cubic spline.

        Raises
        ------
        InputError
            Some x lies outside the profile, which has no value there.
        """
        x = np.asarray(x, dtype=float)
        if x.size:
            self.require(float(x.min()), float(x.max()))
        return np.asarray(self._curve(x), dtype=float)

    def require(self, first: float, last: float) -> None:
        """Raise InputError unless the profile covers track positions first..last [m]."""
        begin, end = self.position[0], self.position[-1]
        tolerance = 1e-9 * max(1.0, abs(begin), abs(end))
        if not (begin - tolerance <= first and last <= end + tolerance):
            raise InputError(f'{self.name} covers {begin:.6g} to {end:.6g} m, but the wheels run '
                             f'from {first:.6g} to {last:.6g} m')


def iso3095(length: float, step: float = 1e-3, seed: int | Sequence[int] = 0, start: float = 0.0,
            longest: float = 2.0, shortest: float | None = None) -> Profile:
    """Random roughness at the limit of ISO 3095:2013, the same for the same seed.

    Harmonics of 1/length with the limit's spectral density (spectra.density) and random phases
    (NumPy's PCG64 from `seed`) add up to a stationary, nearly Gaussian profile that repeats after
    `length`.  Every one-third octave between `longest` and `shortest` [m] has the limit's level.

    Parameters
    ----------
    length, step, start
        Extent, sampling interval and first position [m].
    longest, shortest
        Centres of the outermost one-third octaves [m]; shortest is 2.5 steps unless given.

    Raises
    ------
    InputError
        A length or wavelength that is not positive, or wavelengths that the sampling cannot hold.
    """
    shortest = 2.5 * step if shortest is None else shortest
    if not (step > 0.0 and length >= 2.0 * step):
        raise InputError(f'roughness: {length:g} m in steps of {step:g} m do not make a profile')
    if not 2.0 * step * HALF_BAND <= shortest < longest:
        raise InputError(f'roughness: wavelengths {shortest:g} to {longest:g} m do not fit a step '
                         f'of {step:g} m (the shortest needs {2.0 * HALF_BAND:.2f} steps)')
    samples = round(length / step)
    wavenumber = np.arange(samples // 2 + 1) / (samples * step)
    kept = (wavenumber > 1.0 / (longest * HALF_BAND)) & (wavenumber < HALF_BAND / shortest)
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, wavenumber.size)
    amplitude = np.zeros(wavenumber.size)
    amplitude[kept] = np.sqrt(2.0 * density(wavenumber[kept]) * wavenumber[1])
    one_period = np.fft.irfft(0.5 * samples * amplitude * np.exp(1j * phase), samples)
    position = start + step * np.arange(samples + 1, dtype=np.float64)
    return Profile(position, np.append(one_period, one_period[0]), name='ISO 3095 roughness')


def sine(x: ArrayLike, wavelength: float, amplitude: float) -> Array:
    """amplitude sin(2 pi x / wavelength) [m]."""
    return amplitude * np.sin(2.0 * np.pi * np.asarray(x, dtype=float) / wavelength)


def corrugation(x: ArrayLike, wavelength: float, amplitude: float, begin: float, end: float,
                ramp: float | None = None) -> Array:
    """A sine [m] between track positions begin and end [m], zero elsewhere.

    It grows and fades over `ramp` [m] inside either end as half a cosine; the ramp is two
    wavelengths unless given, and never more than half the stretch.
    """
    x = np.asarray(x, dtype=float)
    ramp = min(2.0 * wavelength if ramp is None else ramp, 0.5 * (end - begin))
    inside = np.minimum(x - begin, end - x)
    envelope = np.where(inside > 0.0, 1.0, 0.0)
    if ramp > 0.0:
        envelope = 0.5 - 0.5 * np.cos(np.pi * np.clip(inside / ramp, 0.0, 1.0))
    return envelope * sine(x - begin, wavelength, amplitude)


def dipped_joint(x: ArrayLike, at: float, depth: float, length: float) -> Array:
    """A dipped rail joint [m]: two parabolas that meet in a cusp of `depth` at track position at.

    z = -depth (1 - |x - at| / (length / 2))^2 over `length`, zero elsewhere; the angle of the dip
    (both ramps together) is 8 depth / length.
    """
    distance = np.abs(np.asarray(x, dtype=float) - at) / (0.5 * length)
    return np.where(distance < 1.0, -depth * (1.0 - distance) ** 2, 0.0)


def read_csv(path: str | Path) -> dict[str, Profile]:
    """Read the irregularity of both rails, {'left': Profile, 'right': Profile}, from a CSV file.

    Columns ``position_m, irregularity_m`` (the same profile under both rails) or
    ``position_m, irregularity_left_m, irregularity_right_m``, in any order; others are ignored.

    Raises
    ------
    InputError
        No such file, a missing column, or a value that is not a finite number (file, line and
        column are named), or positions that do not increase.
    """
    path = Path(path)
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            header = [name.strip() for name in next(csv.reader(file), [])]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'irregularity {path}: cannot be read: {reason(error)}') from error
    both = ['irregularity_left_m', 'irregularity_right_m']
    wanted = both if set(both) & set(header) else ['irregularity_m']
    for name in ['position_m', *wanted]:
        if name not in header:
            raise InputError(f'irregularity {path}: line 1: column {name} is missing, expected '
                             'position_m, irregularity_m or position_m, irregularity_left_m, '
                             f'irregularity_right_m; found {", ".join(header) or "nothing"}')
    names = ['position_m', *wanted]
    values = read_columns(path, header, names, 'irregularity')
    profiles = [Profile(values[:, 0], values[:, 1 + k], name=f'irregularity {path}')
                for k in range(len(wanted))]
    return {'left': profiles[0], 'right': profiles[-1]}


def reason(error: Exception) -> str:
    """Why a file could not be read, without the path that the message has already."""
    text = error.strerror if isinstance(error, OSError) else None
    return text or str(error)


def read_columns(path: Path, header: list[str], names: list[str], what: str) -> Array:
    """Return the named columns (n, len(names)) of a CSV file of numbers.

    Raises
    ------
    InputError
        A value that is not a finite number (file, line and column are named), or fewer than two
        lines of them.
    """
    columns = [header.index(name) for name in names]
    try:
        values = np.loadtxt(path, delimiter=',', skiprows=1, usecols=columns, ndmin=2,
                            encoding='utf-8-sig', comments=None)
        if np.isfinite(values).all() and len(values) > 1:
            return values
    except ValueError:
        pass
    _complain(path, columns, names, what)
    raise InputError(f'{what} {path}: expected at least two lines of data')


def _complain(path: Path, columns: list[int], names: list[str], what: str) -> None:
    """Raise InputError for the first value of the file that is not a finite number."""
    with path.open(newline='', encoding='utf-8-sig') as file:
        reader = csv.reader(file)
        next(reader)
        for row in filter(None, reader):
            for column, name in zip(columns, names, strict=True):
                text = row[column].strip() if column < len(row) else ''
                try:
                    usable = bool(np.isfinite(float(text)))
                except ValueError:
                    usable = False
                if not usable:
                    raise InputError(f'{what} {path}: line {reader.line_num}: column {name}: '
                                     f'expected a finite number, got {text!r}')
