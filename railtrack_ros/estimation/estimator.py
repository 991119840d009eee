"""The estimator: blocks of acceleration and speed in; force, deflection and irregularity out.

For every wheel, with the measured acceleration a of its axle box (z up, compression positive):

    f = F0 + M a                                   contact force; suspension, modes: see `wheel`
    w = response to -f of all wheels on the rail   rail deflection        (thesis 4.4-4.6)
    delta = (f / K)^(1/p)                          indentation            (thesis 2.19)
    r = high-pass of (integral integral a) + delta - w                    irregularity

No clock and no messages: time comes in with the blocks, and what a block gives depends on the
blocks and messages before it and their stamps alone.
"""

from __future__ import annotations

import copy
import math
import pickle
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.dynamics.modes import TrackModes, make_track_modes, ring_length
from railtrack_ros.dynamics.recursive import RecursiveResponse
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.closed_loop import ClosedLoop, Residual
from railtrack_ros.estimation.highpass import ChannelState, filter_block
from railtrack_ros.estimation.notes import Kind, Note
from railtrack_ros.estimation.odometer import Odometer, Run
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.estimation.timeline import SECOND, Place, SampleClock
from railtrack_ros.estimation.wheel import WheelInverse
from railtrack_ros.track.bay import Bay, make_bay
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665  # m/s2

# Bays of the ring beyond the vehicle's length: vibrations that go round it have died away.
DECAY_BAYS = 20

# No sensor measures more [m/s2]: such a sample is as good as none.
STRONGEST = 1e6


@dataclass(frozen=True, eq=False)
class EstimateBlock:
    """What a block of acceleration gives.

    stamp_ns, t (n,): times as they came in. position (n,) [m] and speed (n,) [m/s] of the
    vehicle's reference point, NaN where no speed is known. By axle box, (n,) each, NaN where not
    valid: contact_force [N, compression positive], rail_deflection [m, up positive],
    irregularity [m].
    """

    stamp_ns: int
    t: Array
    position: Array
    speed: Array
    contact_force: dict[str, Array]
    rail_deflection: dict[str, Array]
    irregularity: dict[str, Array]


@dataclass
class Health:
    """Counts since the beginning, and how things stand now.

    bad_samples, missing_blocks: by axle box, samples that were no number and blocks without the
    channel. dead: axle boxes without a single good sample in the last block. extra_channels:
    channels that are no axle box. restarts: stretches begun, the first one included. speed_state:
    'none', 'ok' or 'silent'. speed, position: at the last sample, NaN where not known.
    """

    blocks: int = 0
    samples: int = 0
    dropped_blocks: int = 0
    restarts: int = 0
    gaps: int = 0
    clock_resets: int = 0
    unlocated_blocks: int = 0
    sample_rate: float = float('nan')
    bad_samples: dict[str, int] = field(default_factory=dict)
    missing_blocks: dict[str, int] = field(default_factory=dict)
    dead: tuple[str, ...] = ()
    extra_channels: tuple[str, ...] = ()
    speed_messages: int = 0
    late_speeds: int = 0
    refused_speeds: int = 0
    corrections: int = 0
    speed_state: str = 'none'
    speed: float = float('nan')
    position: float = float('nan')


# What the estimator itself carries from block to block.
_STREAM = ('_clock', '_odometer', '_running', '_health', '_notes', '_faulty')


class _Rail:
    """The wheels of one rail, or of both where they stand side by side."""

    def __init__(self, names: tuple[str, ...], offsets: Array, lines: int) -> None:
        self.names = names
        self.offsets = offsets
        self.lines = lines
        self.response: RecursiveResponse | None = None
        self.wheels: WheelInverse | None = None
        self.loop: ClosedLoop | None = None
        self.channels = ChannelState.stopped(len(names))

    @staticmethod
    def of(vehicle: Vehicle) -> list[_Rail]:
        """The rails of a vehicle; names run along the first, then along the other."""
        found: dict[tuple[float, ...], list[str]] = {}
        for rail in vehicle.rails:
            boxes = vehicle.on_rail(rail)
            found.setdefault(tuple(box.offset for box in boxes), []).extend(
                box.name for box in boxes)
        return [_Rail(tuple(names), np.array(offsets), len(names) // len(offsets))
                for offsets, names in found.items()]

    def begin(self, modes: TrackModes, vehicle: Vehicle, step: float, cut_on: float,
              test_model: bool) -> None:
        """Prepare for a sample period [s]."""
        if self.response is None or self.response.time_step != step:
            self.response = RecursiveResponse(
                modes, step, self.offsets, 'corrected', self.lines)
        self.wheels = WheelInverse(vehicle, step, len(self.names))
        if test_model:
            self.loop = ClosedLoop(
                modes, vehicle, self.names, self.offsets, step, cut_on, self.loop)
        self.channels = ChannelState.stopped(len(self.names))


def _ring(bay: Bay, vehicle: Vehicle, settings: EstimatorSettings) -> int:
    """Return the bays of the ring; InputError if those of the settings are too few."""
    offsets = [box.offset for box in vehicle.axle_boxes]
    if settings.bays_in_ring == 0:
        return ring_length(bay, offsets)
    least = math.ceil((max(offsets) - min(offsets)) / bay.spacing) + DECAY_BAYS
    if settings.bays_in_ring < least:
        raise InputError(
            f'bays_in_ring: expected at least {least} for the length over the axle boxes of '
            f'vehicle {vehicle.name!r}, got {settings.bays_in_ring}'
        )
    return settings.bays_in_ring


class Estimator:
    """Turns blocks of axle-box acceleration into forces, deflections and irregularities.

    Between blocks it can be pickled whole, or its `state` alone, and goes on from there.
    """

    def __init__(
        self, track: Track, vehicle: Vehicle, settings: EstimatorSettings | None = None,
        test_model: bool = True,
    ) -> None:
        """Compute the modes of the track (about a second).

        test_model: whether to test it for `model_residual`, a tenth of the work; no other result
        depends on it.

        Raises
        ------
        InputError
            The vehicle does not fit on the ring of bays, or the track cannot be meshed.
        """
        self.vehicle = vehicle
        self.settings = settings = settings or EstimatorSettings()
        self._test_model = test_model
        WheelInverse(vehicle, 1e-4, 1)  # refuses a wheel that cannot be inverted
        bay = make_bay(track, settings.mesh)
        self._modes = make_track_modes(
            bay, _ring(bay, vehicle, settings), settings.maximum_frequency
        )
        self._rails = _Rail.of(vehicle)
        self._names = {box.name for box in vehicle.axle_boxes}
        self._clock = SampleClock(settings.gap_tolerance)
        self._odometer = Odometer(
            settings.start_position, settings.speed_delay, settings.speed_timeout, bay.spacing
        )
        self._running = False
        self._health = Health(
            bad_samples=dict.fromkeys(self._names, 0), missing_blocks=dict.fromkeys(self._names, 0)
        )
        self._notes: deque[Note] = deque(maxlen=1000)
        self._faulty: set[str] = set()

    # What comes in besides blocks

    def add_speed(self, stamp_ns: int, speed: float) -> None:
        """Take a speed message [m/s]; which blocks it serves depends on its stamp [ns]."""
        self._odometer.add_speed(stamp_ns, speed)

    def set_position(self, stamp_ns: int, position: float) -> None:
        """Take the track position [m] of the vehicle's reference point at a time [ns].

        Positions are corrected from that time on (from the next block if it has passed). The
        irregularity goes on undisturbed; under the wheels the sleepers glide to their corrected
        phase within at most half a bay over 5 % of the distance run.
        """
        self._odometer.set_position(stamp_ns, position)

    # What goes out besides blocks

    @property
    def time_step(self) -> float | None:
        """Sample period [s], None before the first block."""
        return self._clock.step

    @property
    def health(self) -> Health:
        """A copy of the counts."""
        health, odometer = copy.deepcopy(self._health), self._odometer
        health.speed_messages, health.late_speeds = odometer.received, odometer.late
        health.refused_speeds, health.corrections = odometer.refused, odometer.corrections
        health.speed_state = odometer.state
        return health

    def model_residual(self) -> dict[str, dict[str, Residual]]:
        """Measured minus predicted acceleration by axle box and band of frequency.

        From the last test of the model on the wheels behind the leading one, see `closed_loop`:
        ``model_residual()['axle2_left']['100-400 Hz'].share`` is 0.1 where the model leaves a
        tenth of the acceleration unexplained. Empty before the first test.
        """
        found: dict[str, dict[str, Residual]] = {}
        for rail in self._rails:
            if rail.loop is not None:
                found.update(rail.loop.results())
        return found

    def take_notes(self) -> list[Note]:
        """Return the one-line remarks since the last call: what was skipped and why."""
        self._notes.extend(self._odometer.notes)
        self._odometer.notes.clear()
        notes = list(self._notes)
        self._notes.clear()
        return notes

    # The stream's memory

    def state(self) -> bytes:
        """Return all that the stream remembers, some kilobytes and the track model not among it."""
        own = {name: getattr(self, name) for name in _STREAM}
        rails = [
            (rail.channels, rail.response and (rail.response.time_step, rail.response.state()),
             rail.wheels and rail.wheels.state(), rail.loop and rail.loop.state())
            for rail in self._rails
        ]  # fmt: skip
        return pickle.dumps((own, rails))

    def restore(self, state: bytes) -> None:
        """Go on from a state (trusted: it is a pickle) of the same track, vehicle and settings."""
        own, rails = pickle.loads(state)
        for name, value in own.items():
            setattr(self, name, value)
        for rail, (channels, response, wheels, loop) in zip(self._rails, rails, strict=True):
            if response:
                self._begin(rail, response[0])
                assert rail.response is not None
                assert rail.wheels is not None
                rail.response.restore(response[1])
                rail.wheels.restore(wheels)
                if rail.loop is not None and loop is not None:
                    rail.loop.restore(loop)
            rail.channels = channels

    # Blocks

    def process(
        self, stamp_ns: int, t: ArrayLike, channels: Mapping[str, ArrayLike]
    ) -> EstimateBlock | None:
        """Estimate the next block.

        Parameters
        ----------
        stamp_ns
            Time that `t` counts from [ns].
        t
            (n,) times of the samples [s], uniform.
        channels
            Acceleration (n,) [m/s2, up positive] by axle box; a missing one is dead, others are
            ignored.

        Returns
        -------
        EstimateBlock or None
            None for a block that was dropped: without usable times, repeated, or from the past;
            and for the first 32 single samples of a stream of such blocks.
        """
        t = np.asarray(t, dtype=np.float64)
        place, remark = self._clock.place(stamp_ns, t)
        if remark:
            self._notes.append(remark if isinstance(remark, Note) else Note(remark))
        if place is Place.DROPPED:
            self._health.dropped_blocks += 1
            return None
        if place is Place.HELD:
            self._odometer.begin(stamp_ns + round(float(t[0]) * SECOND))
            return None
        step = self._clock.step
        assert step is not None
        self._count(place, t.size, step)
        if place is Place.REWOUND:
            self._odometer.rewind(self._clock.begun_ns)
        measured = self._channels(t.size, channels)
        run = self._odometer.run(stamp_ns, t, step, place is Place.CONTINUED)
        if run is None:
            self._running = False
            self._health.unlocated_blocks += 1
            self._health.speed = self._health.position = float('nan')
            return self._nothing(stamp_ns, t)
        if place is not Place.CONTINUED or not self._running:
            self._start(run, step)
        self._health.speed, self._health.position = float(run.speed[-1]), float(run.position[-1])
        block = EstimateBlock(stamp_ns, t, run.position, run.speed, {}, {}, {})
        for rail in self._rails:
            self._estimate(rail, measured, run, step, block)
        return block

    def _count(self, place: Place, samples: int, step: float) -> None:
        health = self._health
        health.blocks += 1
        health.samples += samples
        health.sample_rate = 1.0 / step
        health.gaps += place is Place.STARTED and health.blocks > 1
        health.clock_resets += place is Place.REWOUND

    def _nothing(self, stamp_ns: int, t: Array) -> EstimateBlock:
        def unknown() -> dict[str, Array]:
            return {box.name: np.full(t.size, np.nan) for box in self.vehicle.axle_boxes}

        return EstimateBlock(
            stamp_ns, t, np.full(t.size, np.nan), np.full(t.size, np.nan),
            unknown(), unknown(), unknown(),
        )  # fmt: skip

    def _channels(self, samples: int, channels: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Acceleration (n,) of every axle box without gravity, NaN where there is none."""
        health = self._health
        health.extra_channels = tuple(sorted(set(channels) - self._names))
        measured, dead = {}, []
        for box in self.vehicle.axle_boxes:
            name = box.name
            a = np.array(channels.get(name, ()), dtype=np.float64)
            if a.shape != (samples,):
                what = 'no channel' if a.size == 0 else f'{a.size} values for {samples} samples'
                a = np.full(samples, np.nan)
                health.missing_blocks[name] += 1
                self._fault(name, what, Kind.DEFECT if name in channels else Kind.NORMAL)
            if self.settings.input_includes_gravity:
                a -= STANDARD_GRAVITY
            a[~(np.abs(a) < STRONGEST)] = np.nan
            bad = int(np.isnan(a).sum())
            if bad == samples:
                dead.append(name)
            if bad:
                health.bad_samples[name] += bad
                self._fault(name, f'{bad} of {samples} samples are no number')
            elif name in self._faulty:
                self._faulty.discard(name)
                self._notes.append(Note(f'{name}: good samples again', Kind.NORMAL))
            measured[name] = a
        health.dead = tuple(dead)
        return measured

    def _fault(self, name: str, what: str, kind: Kind = Kind.DEFECT) -> None:
        if name not in self._faulty:
            self._faulty.add(name)
            self._notes.append(Note(
                f'{name}: {what}: taken to carry its static load, not estimated', kind))

    def _begin(self, rail: _Rail, step: float) -> None:
        rail.begin(self._modes, self.vehicle, step, self.settings.cut_on_wavelength,
                   self._test_model)

    def _start(self, run: Run, step: float) -> None:
        """Begin a stretch: all wheels stand on the statically deflected rail."""
        for rail in self._rails:
            self._begin(rail, step)
            assert rail.response is not None
            load = np.full((rail.lines, rail.offsets.size), -self.vehicle.wheel.static_load)
            rail.response.settle(run.place[0], load)
        self._health.restarts += 1
        self._running = True

    def _estimate(
        self, rail: _Rail, measured: Mapping[str, Array], run: Run, step: float,
        block: EstimateBlock,
    ) -> None:  # fmt: skip
        acceleration = np.column_stack([measured[name] for name in rail.names])
        of_boxes = acceleration.copy() if rail.loop is not None else acceleration
        assert rail.response is not None
        assert rail.wheels is not None
        force, indentation, alive = rail.wheels(acceleration)
        shape = (run.place.size, rail.lines, rail.offsets.size)
        deflection = rail.response.deflection(
            run.place, -force.reshape(shape)).reshape(force.shape)
        valid, irregularity = filter_block(
            rail.channels, acceleration, indentation - deflection, alive, run.speed, step,
            self.settings.cut_on_wavelength, self.settings.minimum_speed,
        )  # fmt: skip
        if rail.loop is not None:
            rail.loop.add(run.place, run.speed, of_boxes, irregularity)
        force[~valid] = np.nan
        deflection[~valid] = np.nan
        for i, name in enumerate(rail.names):
            block.contact_force[name] = np.ascontiguousarray(force[:, i])
            block.rail_deflection[name] = np.ascontiguousarray(deflection[:, i])
            block.irregularity[name] = np.ascontiguousarray(irregularity[:, i])
