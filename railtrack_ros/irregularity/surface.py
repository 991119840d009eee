"""What the wheels of a vehicle run over: measured profiles and shapes by formula, added up.

A part is told in words (:func:`read_part`): a CSV file, or NAME:NUMBER:NUMBER ...

    iso3095:SEED                       random roughness at the limit of ISO 3095, rail by rail
    sine:WAVELENGTH:AMPLITUDE          from end to end
    corrugation:WAVELENGTH:AMPLITUDE:FROM:TO
    joint:AT:DEPTH:LENGTH              a dipped rail joint at track position AT
    flat:LENGTH:DEPTH[:AXLE_BOX]       a wheel flat on every wheel, or on one

All lengths in metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.errors import InputError
from railtrack_ros.irregularity import profile
from railtrack_ros.vehicle.description import RAILS, AxleBox, Vehicle

Array = NDArray[np.float64]

ROUGHNESS_STEP = 1e-3  # m
ROUGHNESS_LENGTHS = (20.0, 10e3)  # least length made and length after which it repeats, m

# Names of the numbers of each kind of part, and the numbers that have to be positive.
FORMS = {
    'iso3095': ('SEED',),
    'sine': ('WAVELENGTH', 'AMPLITUDE'),
    'corrugation': ('WAVELENGTH', 'AMPLITUDE', 'FROM', 'TO'),
    'joint': ('AT', 'DEPTH', 'LENGTH'),
    'flat': ('LENGTH', 'DEPTH'),
}
POSITIVE = ('WAVELENGTH', 'AMPLITUDE', 'DEPTH', 'LENGTH')


def wheel_flat(rolled: ArrayLike, radius: float, length: float, depth: float) -> Array:
    """Irregularity [m] by a worn flat after the wheel of a radius [m] has rolled so far [m].

    z = -depth / 2 (1 - cos(2 pi s / length)) over the flat's `length`, once in a circumference,
    zero elsewhere: the rounded flat of Newton and Clark (1979).  At the start the flat's middle is
    on top of the wheel.  A fresh flat, a chord, is length^2 / (8 radius) deep.
    """
    around = 2.0 * math.pi * radius
    s = np.mod(np.asarray(rolled, dtype=float) + 0.5 * (around + length), around)
    return np.where(s < length, -0.5 * depth * (1.0 - np.cos(2.0 * np.pi * s / length)), 0.0)


@dataclass(frozen=True)
class Part:
    """One part of a surface: its kind ('file' or a key of FORMS), its numbers and its text."""

    kind: str
    values: tuple[float, ...]
    text: str
    axle_box: str | None = None


def read_part(text: str) -> Part:
    """Read a part as told above; whatever is not of that form is the name of a CSV file.

    Raises
    ------
    InputError
        Numbers that do not fit the form.
    """
    kind, *words = text.split(':')
    if kind not in FORMS:
        return Part('file', (), text)
    names = FORMS[kind]
    form = ':'.join([kind, *names]) + ('[:AXLE_BOX]' if kind == 'flat' else '')
    axle_box = words.pop() if kind == 'flat' and len(words) == len(names) + 1 else None
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = ()
    if len(values) != len(names) or not np.isfinite(values).all():
        raise InputError(f'irregularity {text!r}: expected {form} with numbers, in metres')
    for name, value in zip(names, values, strict=True):
        if name in POSITIVE and not value > 0.0:
            raise InputError(f'irregularity {text!r}: {name}: expected a number above 0')
        if name == 'SEED' and (value < 0.0 or value != round(value)):
            raise InputError(f'irregularity {text!r}: SEED: expected a whole number from 0 on')
    if kind == 'corrugation' and not values[2] < values[3]:
        raise InputError(f'irregularity {text!r}: FROM has to be less than TO')
    return Part(kind, values, text, axle_box)


class Surface:
    """The sum of parts under every wheel of a vehicle.

    Parameters
    ----------
    first, last
        Track positions [m] that the vehicle's reference point reaches.
    start
        Its position at the start, from which the wheels roll [m].

    Raises
    ------
    InputError
        A file that cannot be read or does not reach far enough, an axle box that the vehicle does
        not have, or a flat longer than the wheel's circumference.
    """

    def __init__(self, parts: Sequence[Part], vehicle: Vehicle, start: float, first: float,
                 last: float) -> None:
        self._parts, self._start, self._radius = tuple(parts), start, vehicle.wheel.radius
        self._profiles: dict[str, dict[str, profile.Profile]] = {}
        offsets = [box.offset for box in vehicle.axle_boxes]
        low, high = first + min(offsets), last + max(offsets)
        names = [box.name for box in vehicle.axle_boxes]
        for part in self._parts:
            if part.axle_box is not None and part.axle_box not in names:
                raise InputError(f'irregularity {part.text!r}: the vehicle has no axle box '
                                 f'{part.axle_box!r}, it has {", ".join(names)}')
            if part.kind == 'flat' and not part.values[0] < 2.0 * math.pi * self._radius:
                raise InputError(f'irregularity {part.text!r}: LENGTH is more than the '
                                 f"wheel's circumference, {2.0 * math.pi * self._radius:.3g} m")
            if part.kind == 'file':
                profiles = profile.read_csv(Path(part.text))
                for box in vehicle.axle_boxes:
                    profiles[box.rail].require(first + box.offset, last + box.offset)
                self._profiles[part.text] = profiles
            elif part.kind == 'iso3095':
                least, most = ROUGHNESS_LENGTHS
                length = min(max(high - low + 2.0 * ROUGHNESS_STEP, least), most)
                self._profiles[part.text] = {
                    rail: profile.iso3095(length, ROUGHNESS_STEP, (int(part.values[0]), index), low)
                    for index, rail in enumerate(RAILS)}

    def at(self, box: AxleBox, position: Array) -> Array:
        """Irregularity [m] under a wheel with the reference point at `position` (n,) [m]."""
        place = position + box.offset
        total = np.zeros_like(place)
        for part in self._parts:
            if part.kind == 'file':
                total += self._profiles[part.text][box.rail].at(place)
            elif part.kind == 'iso3095':
                made = self._profiles[part.text][box.rail]
                begin = made.position[0]
                total += made.at(begin + np.mod(place - begin, made.position[-1] - begin))
            elif part.kind == 'sine':
                total += profile.sine(place, *part.values)
            elif part.kind == 'corrugation':
                total += profile.corrugation(place, *part.values)
            elif part.kind == 'joint':
                total += profile.dipped_joint(place, *part.values)
            elif part.axle_box in (None, box.name):
                total += wheel_flat(position - self._start, self._radius, *part.values)
        return total
