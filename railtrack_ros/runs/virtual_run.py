"""A vehicle with axle-box accelerometers on a virtual track: measurement and truth.

The truth is the full finite-element model (Newmark, Hertzian contact) on a mesh and a time step
finer than those of the estimator that is going to be judged by it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.bags.signals import Decimator
from railtrack_ros.dynamics.newmark import ForwardResult, FullModel
from railtrack_ros.errors import InputError
from railtrack_ros.irregularity import profile
from railtrack_ros.irregularity.surface import Part, Surface
from railtrack_ros.track.bay import Mesh
from railtrack_ros.track.description import Track
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import RAILS, AxleBox, Vehicle

Array = NDArray[np.float64]

TRUTH_MESH = Mesh(elements_per_bay=12, elements_per_pad=4)
POINT_MESH = Mesh(elements_per_bay=12)  # of supports without elements over the pad
# Newmark's period error at 2.5 kHz stays below 1 % up to this step, s.
LONGEST_STEP = 20e-6
# The rail is smooth where the run begins and its irregularity grows over this distance, m.
FADE_IN = 1.0
# Sampling of the random roughness, its least length, and the length after which it repeats, m.
ROUGHNESS_STEP = 1e-3
SHORTEST_ROUGHNESS = 20.0
ROUGHNESS_PERIOD = 10e3
# Fine time steps that are computed at a time.
CHUNK = 12_800


@dataclass(frozen=True)
class Corrugation:
    """A sinusoidal stretch from track position `begin` to `end` (SI units), on one rail or both."""

    wavelength: float
    amplitude: float
    begin: float
    end: float
    rail: str | None = None

    @classmethod
    def parse(cls, text: str) -> Corrugation:
        """Read WAVELENGTH:AMPLITUDE:FROM:TO or WAVELENGTH:AMPLITUDE:FROM:TO:RAIL."""
        expected = f'corrugation {text!r}: expected WAVELENGTH:AMPLITUDE:FROM:TO in metres'
        parts = text.split(':')
        rail = parts.pop().strip() if len(parts) == 5 else None
        if len(parts) != 4 or (rail is not None and rail not in RAILS):
            raise InputError(f'{expected}, then :left or :right for one rail')
        try:
            wavelength, amplitude, begin, end = (float(part) for part in parts)
        except ValueError:
            raise InputError(f'{expected}, for example 0.045:10e-6:200:260') from None
        if not (0.0 < wavelength < math.inf and 0.0 < amplitude < math.inf):
            raise InputError(f'{expected}, WAVELENGTH and AMPLITUDE above 0')
        if not -math.inf < begin < end < math.inf:
            raise InputError(f'{expected}, FROM before TO')
        return cls(wavelength, amplitude, begin, end, rail)


    def __str__(self) -> str:
        fields = (self.wavelength, self.amplitude, self.begin, self.end)
        return ':'.join([*(f'{value:g}' for value in fields), *([self.rail] if self.rail else [])])


@dataclass(frozen=True)
class RunSettings:
    """What is driven, and how it is measured.

    Attributes
    ----------
    duration, speed, acceleration, start_position
        The reference point starts at `start_position` [m] with `speed` [m/s] and `acceleration`
        [m/s2]; a vehicle that brakes to a stop stays where it is.
    roughness
        'none', 'iso3095' (the limit curve, different on the two rails) or a CSV file.
    roughness_level
        Gain of the roughness, dB: -6 is half of it.
    corrugations
        Corrugated stretches, added to the roughness.
    irregularity
        Further parts, added to both: joints, wheel flats, files (`irregularity.surface`).
    noise
        Standard deviation of the accelerometers' white noise, m/s2.
    sample_rate, block
        Sampling frequency, Hz, and duration of a message, s.
    seed
        Of roughness and noise: the same seed gives the same run.
    """

    duration: float
    speed: float
    acceleration: float = 0.0
    start_position: float = 0.0
    roughness: str = 'none'
    roughness_level: float = 0.0
    corrugations: tuple[Corrugation, ...] = ()
    irregularity: tuple[Part, ...] = ()
    noise: float = 0.3
    sample_rate: float = 25600.0
    block: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        limits = {
            'sample_rate': (500.0, 200e3),
            'block': (1.0 / self.sample_rate if self.sample_rate > 0 else 0.0, 10.0),
            'duration': (self.block, math.inf),
            'speed': (0.0, 150.0),
            'acceleration': (-10.0, 10.0),
            'start_position': (-1e7, 1e7),
            'noise': (0.0, 1e4),
            'seed': (0, 2**63 - 1),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f'{name} {value:g}: expected a number of at least {low:g}'
                                 + (f' and at most {high:g}' if high < math.inf else ''))

    @property
    def samples(self) -> int:
        """Number of samples of a channel."""
        return round(self.duration * self.sample_rate)

    @property
    def samples_per_block(self) -> int:
        """Number of samples of a message; the last one may be shorter."""
        return max(1, round(self.block * self.sample_rate))

    @property
    def oversampling(self) -> int:
        """Time steps of the full model in a sample period, at least two."""
        return max(2, math.ceil(1.0 / (LONGEST_STEP * self.sample_rate)))

    def speed_at(self, time: Array | float) -> Array:
        """Speed [m/s] at times [s] after the first sample; before it, as if always accelerating."""
        return np.maximum(self.speed + self.acceleration * np.asarray(time), 0.0)

    def position_at(self, time: Array | float) -> Array:
        """Track position [m] of the reference point at times [s] from the first sample on."""
        time = np.asarray(time)
        if self.acceleration < 0.0:
            time = np.minimum(time, -self.speed / self.acceleration)
        return self.start_position + (self.speed + 0.5 * self.acceleration * time) * time


@dataclass(frozen=True)
class VirtualBlock:
    """One message's worth of a virtual run.

    Attributes
    ----------
    first
        Index of the first sample in the run.
    position
        (n,) track position of the reference point, m.
    acceleration, contact_force, rail_deflection, irregularity
        (n,) float32 by axle box: measured acceleration with noise, then the truth. The
        irregularity is that at the wheel's own place.
    """

    first: int
    position: Array
    acceleration: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    contact_force: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    rail_deflection: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    irregularity: dict[str, NDArray[np.float32]] = field(default_factory=dict)


class RailSurface:
    """Irregularity of the two rails of a virtual run, at any place that its wheels reach.

    Raises
    ------
    InputError
        The roughness file cannot be read or does not reach far enough.
    """

    def __init__(self, vehicle: Vehicle, settings: RunSettings) -> None:
        offsets = [box.offset for box in vehicle.axle_boxes]
        # The full model runs on for half the length of the decimation filter.
        end = float(settings.position_at(settings.duration + 0.1))
        self._first = settings.start_position + min(offsets)
        self._last = end + max(offsets)
        self._start = settings.start_position
        self._corrugations = settings.corrugations
        self._parts = Surface(settings.irregularity, vehicle, self._start, self._start, end)
        self._roughness = self._load(settings)
        self._gain = 10.0 ** (settings.roughness_level / 20.0)

    def _load(self, settings: RunSettings) -> dict[str, profile.Profile]:
        if settings.roughness == 'none':
            return {}
        if settings.roughness == 'iso3095':
            length = max(self._last - self._first, SHORTEST_ROUGHNESS) + 2.0 * ROUGHNESS_STEP
            return {
                rail: profile.iso3095(min(length, ROUGHNESS_PERIOD), ROUGHNESS_STEP,
                                      seed=(settings.seed, index), start=self._first)
                for index, rail in enumerate(RAILS)
            }
        if not Path(settings.roughness).is_file():
            raise InputError(
                f'roughness {settings.roughness!r}: expected none, iso3095 or a CSV file')
        measured = profile.read_csv(settings.roughness)
        for rail in RAILS:
            measured[rail].require(self._first, self._last)
        return measured

    def under(self, box: AxleBox, position: Array) -> Array:
        """Irregularity [m] under an axle box, all parts, with the reference point at (n,) [m]."""
        return self.at(box.rail, position, box.offset) + self._parts.at(box, position)

    def at(self, rail: str, position: Array, offset: float) -> Array:
        """Irregularity [m] of a rail under a wheel, the reference point being at (n,) [m]."""
        place = position + offset
        surface = np.zeros_like(place)
        if rail in self._roughness:
            roughness = self._roughness[rail]
            begin = roughness.position[0]
            period = roughness.position[-1] - begin
            surface += self._gain * roughness.at(begin + np.mod(place - begin, period))
        for stretch in self._corrugations:
            if stretch.rail in (None, rail):
                surface += profile.corrugation(
                    place, stretch.wavelength, stretch.amplitude, stretch.begin, stretch.end)
        run = np.clip((position - self._start) / FADE_IN, 0.0, 1.0)
        return surface * (0.5 - 0.5 * np.cos(np.pi * run))


class _RailRun:
    """The wheels of one rail through the full model, filtered to the sample rate."""

    def __init__(self, track: Track, vehicle: Vehicle, settings: RunSettings, rail: str,
                 surface: RailSurface) -> None:
        self.boxes: tuple[AxleBox, ...] = vehicle.on_rail(rail)
        self._surface = surface
        self._settings = settings
        on_points = track.support.kind.startswith('concentrated')
        self._model = FullModel(
            BayRow(track, POINT_MESH if on_points else TRUTH_MESH), vehicle,
            [box.offset for box in self.boxes],
            time_step=1.0 / (settings.sample_rate * settings.oversampling),
            start_position=settings.start_position)
        self._decimators = [Decimator(settings.oversampling) for _ in range(3)]

    @property
    def reach(self) -> int:
        return self._decimators[0].reach

    def irregularity(self, position: Array) -> Array:
        """Irregularity (n, wheels) when the reference point is at `position` (n,)."""
        return np.column_stack([self._surface.under(box, position) for box in self.boxes])

    def advance(self, position: Array) -> tuple[Array, Array, Array]:
        """Acceleration, contact force and rail deflection, (m, wheels) each, that got complete."""
        result: ForwardResult = self._model.run(position, self.irregularity(position))
        outputs = (result.axle_box_acceleration, result.contact_force, result.rail_deflection)
        acceleration, force, deflection = (
            decimator.process(values)
            for decimator, values in zip(self._decimators, outputs, strict=True))
        return acceleration, force, deflection


def simulate_run(track: Track, vehicle: Vehicle, settings: RunSettings) -> Iterator[VirtualBlock]:
    """Yield the blocks of a virtual measurement run in order, as they are computed.

    The wheels start in static equilibrium. The two rails, which are not coupled, are computed
    side by side.

    Raises
    ------
    InputError
        The roughness does not fit the run.
    """
    surface = RailSurface(vehicle, settings)
    rails = [_RailRun(track, vehicle, settings, rail, surface) for rail in vehicle.rails]
    noises = {
        box.name: np.random.default_rng((settings.seed, len(RAILS), index))
        for index, box in enumerate(vehicle.axle_boxes)
    }
    factor = settings.oversampling
    fine_steps = (settings.samples - 1) * factor + 1 + rails[0].reach
    time_step = 1.0 / (settings.sample_rate * factor)
    pending: list[list[Array]] = [[np.empty((0, len(rail.boxes)))] * 3 for rail in rails]
    done = 0
    with ThreadPoolExecutor(len(rails)) as pool:
        for begin in range(0, fine_steps, CHUNK):
            steps = np.arange(begin, min(begin + CHUNK, fine_steps), dtype=np.float64)
            position = settings.position_at(steps * time_step)
            new = list(pool.map(lambda rail, at=position: rail.advance(at), rails))
            pending = [[np.concatenate(pair) for pair in zip(old, fresh, strict=True)]
                       for old, fresh in zip(pending, new, strict=True)]
            while True:
                n = min(settings.samples_per_block, settings.samples - done)
                if n == 0 or len(pending[0][0]) < n:
                    break
                yield _block(rails, [[part[:n] for part in parts] for parts in pending],
                             done, settings, noises)
                pending = [[part[n:] for part in parts] for parts in pending]
                done += n


def _block(rails: list[_RailRun], outputs: list[list[Array]], first: int, settings: RunSettings,
           noises: dict[str, np.random.Generator]) -> VirtualBlock:
    n = len(outputs[0][0])
    time: Array = np.arange(first, first + n, dtype=np.float64) / settings.sample_rate
    position = settings.position_at(time)
    block = VirtualBlock(first, position)
    for rail, (acceleration, force, deflection) in zip(rails, outputs, strict=True):
        irregularity = rail.irregularity(position)
        for wheel, box in enumerate(rail.boxes):
            noise = settings.noise * noises[box.name].standard_normal(n)
            block.acceleration[box.name] = (acceleration[:, wheel] + noise).astype(np.float32)
            block.contact_force[box.name] = force[:, wheel].astype(np.float32)
            block.rail_deflection[box.name] = deflection[:, wheel].astype(np.float32)
            block.irregularity[box.name] = irregularity[:, wheel].astype(np.float32)
    return block
