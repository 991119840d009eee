"""The full model over a recorded run, to tell whether it explains what was measured.

The estimator recovers the irregularity under each wheel from the wheel's acceleration. Here every
wheel of the full Newmark model runs over the irregularity that it itself recovered, and what comes
out (contact force, rail deflection, axle-box acceleration) is held against the estimate, the
measurement and, for a synthesised run, the truth.

The recovered irregularity has passed a causal high-pass (Butterworth, order 4, cut-on 3 m): its
phase is that of the filter, 15 degrees still at a tenth of the cut-on wavelength. Before it drives
the model it passes the same filter backwards, which removes the phase. What is left out is below
the cut-on: the model gives the static load and the dynamics above. So signals are compared in a
band that begins at twice the cut-on frequency, or at 20 Hz if that is higher, and the model gets a
run-up before the stretch in which its transients die away.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.errors import InputError
from railtrack_ros.estimation.highpass import (
    SETTLING_TIME,
    SETTLING_WAVELENGTHS,
    ChannelState,
    filter_block,
)
from railtrack_ros.estimation.odometer import GLIDE
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.runs import comparison
from railtrack_ros.runs.comparison import Band, Error
from railtrack_ros.runs.driven import LONGEST_STEP, drive, oversampling
from railtrack_ros.track.bay import Bay
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]
Channels = Mapping[str, Array]

SETTLING = 0.5          # s that the driven model needs until its start no longer shows
LARGEST_SLIP = 1e-3     # m a sample: a position that moves on by more was corrected
SECTION = 10.0          # m of track that errors are summed up over
RAMP = 1.0              # cut-on wavelengths over which the irregularity grows at its start


@dataclass(frozen=True)
class Samples:
    """A stretch of a run on one uniform time grid; a sample without a value is NaN.

    Attributes
    ----------
    start_ns, time_step
        Time of the first sample [ns since the epoch] and sample period [s].
    start_time
        The same time in seconds after the first sample of the run.
    position, speed
        (n,) of the vehicle's reference point [m] and [m/s].
    measured
        Acceleration by axle box (n,) [m/s2].
    estimated, truth
        Quantity ('contact_force', 'rail_deflection', 'irregularity') -> axle box -> (n,), SI.
        truth is empty where the recording has none.
    """

    start_ns: int
    time_step: float
    start_time: float
    position: Array
    speed: Array
    measured: Channels
    estimated: Mapping[str, Channels]
    truth: Mapping[str, Channels] = field(default_factory=dict)


@dataclass(frozen=True)
class Extent:
    """Track positions [m], duration [s] and lowest, mean and highest speed [m/s] of a stretch."""

    begin: float
    end: float
    duration: float
    speeds: tuple[float, float, float]

    def joined(self, later: Extent) -> Extent:
        """Return the extent of this and a later stretch."""
        duration = self.duration + later.duration
        low, mean, high = self.speeds
        mean += (later.speeds[1] - mean) * later.duration / duration
        return Extent(min(self.begin, later.begin), max(self.end, later.end), duration,
                      (min(low, later.speeds[0]), mean, max(high, later.speeds[2])))


@dataclass(frozen=True)
class Replayed:
    """What the full model made of a run.

    Attributes
    ----------
    samples
        The run, with run-up and run-out around the stretch asked for.
    stretch
        The samples of the stretch.
    excitation
        Irregularity that drove each wheel (n,) [m], zero phase.
    full_model
        Quantity -> axle box -> (n,), NaN where the model had not settled or was not driven.
    truth_irregularity
        True irregularity through the high-pass of the estimate (n,) [m] by axle box; empty
        without truth.
    band
        Where signals were compared.
    model_step
        The full model's time step [s].
    errors
        The error table over the stretch.
    whole
        What the run covers of which this is a window, None for a run in one piece.
    """

    samples: Samples
    stretch: slice
    excitation: Channels
    full_model: Mapping[str, Channels]
    truth_irregularity: Channels
    band: Band
    model_step: float
    errors: list[Error]
    whole: Extent | None = None

    @property
    def compared(self) -> tuple[float, float]:
        """Track positions of the reference point [m] between which the model has an answer."""
        if self.whole is not None:
            return self.whole.begin, self.whole.end
        good = np.zeros(self.samples.position.size, dtype=bool)
        for values in self.full_model['contact_force'].values():
            good[self.stretch] |= np.isfinite(values[self.stretch])
        places = self.samples.position[good]
        return float(places.min()), float(places.max())

    @property
    def extent(self) -> Extent:
        """Return what the stretch covers."""
        if self.whole is not None:
            return self.whole
        speed = np.abs(self.samples.speed[self.stretch])
        return Extent(*self.compared, speed.size * self.samples.time_step,
                      (float(speed.min()), float(speed.mean()), float(speed.max())))

    def signals(self, quantity: str) -> dict[str, Channels]:
        """Return all descriptions of a quantity by who gives it, each by axle box (n,)."""
        if quantity == 'irregularity':
            found = {'truth': self.truth_irregularity,
                     'estimated': self.samples.estimated[quantity]}
        elif quantity == 'axle_box_acceleration':
            found = {'measured': self.samples.measured, 'full_model': self.full_model[quantity]}
        else:
            found = {'truth': self.samples.truth.get(quantity, {}),
                     'full_model': self.full_model[quantity],
                     'estimated': self.samples.estimated[quantity]}
        return {who: channels for who, channels in found.items() if channels}


# Which description is held against which, by quantity.
PAIRS = {
    'contact_force': (('full_model', 'estimated'), ('estimated', 'truth'),
                      ('full_model', 'truth')),
    'rail_deflection': (('full_model', 'estimated'), ('estimated', 'truth'),
                        ('full_model', 'truth')),
    'axle_box_acceleration': (('full_model', 'measured'),),
    'irregularity': (('estimated', 'truth'),),
}


def replay(samples: Samples, stretch: slice, bay: Bay | BayRow, vehicle: Vehicle,
           settings: EstimatorSettings, longest_step: float = LONGEST_STEP,
           progress: Callable[[float], None] = lambda share: None,
           section_length: float = SECTION) -> Replayed:
    """Drive the full model over a run with the irregularity recovered from it, and compare.

    Parameters
    ----------
    samples
        The run; `run_up` tells how much of it before and after the stretch is used.
    stretch
        The samples that the comparison is about.
    bay
        A periodic linear track's bay, or the row of bays of any track.
    settings
        Those of the estimator, for its high-pass.
    longest_step
        Upper bound of the model's time step [s].
    progress
        Called with the share of the run that is done.
    section_length
        Of the sections in the error table [m].

    Raises
    ------
    InputError
        No wheel has a recovered irregularity long enough to drive the model and settle, or speed
        and sample rate leave nothing to compare.
    """
    speed = np.abs(samples.speed)
    cut_on = settings.cut_on_wavelength
    band = comparison.band_for(float(speed[stretch].max()), cut_on, samples.time_step)
    excitation, driven = {}, {}
    for box in vehicle.axle_boxes:
        excitation[box.name], driven[box.name] = _excitation(
            samples.estimated['irregularity'][box.name], speed, samples.time_step, settings)
    if not any(mask[stretch].any() for mask in driven.values()):
        raise InputError(
            'the stretch holds no recovered irregularity that is long enough to drive the full '
            f'model: it takes {SETTLING:g} s and {2 * SETTLING_WAVELENGTHS + RAMP:g} cut-on '
            f'wavelengths of {cut_on:g} m of undisturbed running above '
            f'{settings.minimum_speed:g} m/s')
    model = drive(bay, vehicle, _place(samples, _repeat(bay)), excitation, samples.time_step,
                  longest_step, progress)
    for channels in model.values():
        for name, values in channels.items():
            values[~driven[name]] = np.nan
    truth = {name: _as_estimated(values, speed, samples.time_step, settings)
             for name, values in samples.truth.get('irregularity', {}).items()}
    found = Replayed(samples, stretch, excitation, model, truth, band,
                     samples.time_step / oversampling(samples.time_step, longest_step), [])
    found.errors.extend(_errors(found, vehicle, section_length))
    if not any(e.quantity == 'contact_force' for e in found.errors):
        raise InputError('the stretch is too short to compare anything: '
                         f'{(stretch.stop - stretch.start) * samples.time_step:.3g} s')
    return found


def run_up(settings: EstimatorSettings) -> tuple[float, float, float, float]:
    """Return what a stretch needs around it: m and then s before it, s and then m after it.

    Before it the irregularity has to grow, the model to settle and the filters of the comparison
    to settle too; after it these filters, and those that run backwards.
    """
    edge = comparison.EDGE / comparison.LOWEST
    ramp = RAMP * settings.cut_on_wavelength
    backwards = SETTLING_WAVELENGTHS * settings.cut_on_wavelength
    return ramp, SETTLING + edge, SETTLING_TIME + edge, ramp + backwards


def _repeat(track: Bay | BayRow) -> float | None:
    """Return the length [m] after which the track repeats, None where it never does."""
    if isinstance(track, BayRow):
        return track.bay.spacing if len(track.kinds) == 1 else None
    return track.spacing


def _place(samples: Samples, spacing: float | None) -> Array:
    """Return the way (n,) [m] that the model's wheels go: positions without their corrections.

    Where a position reference moved the position, whole sleeper bays are left out and the rest is
    made up over the distance run, as the estimator does: a wheel cannot jump along the rail.
    Without a spacing nothing is left out.
    """
    speed = samples.speed
    run = 0.5 * samples.time_step * (speed[1:] + speed[:-1])
    moves = np.diff(samples.position)
    jumps = np.flatnonzero(np.abs(moves - run) > LARGEST_SLIP)
    if not jumps.size:
        return samples.position
    corrections = moves[jumps] - run[jumps]
    moves[jumps] = run[jumps]
    behind = 0.0
    for begin, end, correction in zip(jumps, [*jumps[1:], moves.size], corrections, strict=True):
        whole = spacing * round(correction / spacing) if spacing else 0.0
        behind += correction - whole
        made_up = np.minimum(GLIDE * np.cumsum(np.abs(run[begin:end])), abs(behind))
        moves[begin:end] += np.copysign(np.diff(made_up, prepend=0.0), behind)
        behind -= np.copysign(made_up[-1], behind)
    return samples.position[0] + np.concatenate([[0.0], np.cumsum(moves)])


def _excitation(irregularity: Array, speed: Array, time_step: float, settings: EstimatorSettings
                ) -> tuple[Array, NDArray[np.bool_]]:
    """Return what drives a wheel (n,) [m], and where the model's answer to it has settled."""
    backwards = _high_pass(irregularity[::-1], speed[::-1], time_step, settings)[::-1]
    excitation = np.zeros(irregularity.size)
    settled = np.zeros(irregularity.size, dtype=bool)
    distance = np.cumsum(speed) * time_step
    for begin, end in comparison.pieces(np.isfinite(backwards)):
        part = slice(begin, end)
        inside = np.minimum(distance[part] - distance[begin], distance[end - 1] - distance[part])
        ramp = np.clip(inside / (RAMP * settings.cut_on_wavelength), 0.0, 1.0)
        excitation[part] = backwards[part] * (0.5 - 0.5 * np.cos(np.pi * ramp))
        full = begin + np.flatnonzero(ramp >= 1.0)
        if full.size:
            settled[full[0] + round(SETTLING / time_step):full[-1] + 1] = True
    return excitation, settled


def _as_estimated(truth: Array, speed: Array, time_step: float, settings: EstimatorSettings
                  ) -> Array:
    """Return the true irregularity (n,) as an exact estimator would give it."""
    return _high_pass(truth, speed, time_step, settings)


def _high_pass(values: Array, speed: Array, time_step: float, settings: EstimatorSettings
               ) -> Array:
    """Pass values (n,) through the estimator's high-pass; NaN until it has settled."""
    alive = np.isfinite(values)
    column = np.where(alive, values, 0.0)[:, None]
    _, filtered = filter_block(
        ChannelState.stopped(1), np.zeros_like(column), column, alive[:, None],
        np.ascontiguousarray(speed), time_step, settings.cut_on_wavelength, settings.minimum_speed)
    return filtered[:, 0]


def _errors(found: Replayed, vehicle: Vehicle, section_length: float) -> list[Error]:
    """Compare all pairs of all axle boxes over the stretch, within the band."""
    distance = np.cumsum(np.abs(found.samples.speed))[found.stretch] * found.samples.time_step
    lines = []
    for quantity, pairs in PAIRS.items():
        signals = found.signals(quantity)
        for box in vehicle.axle_boxes:
            limited = {who: found.band.limit(channels[box.name])[found.stretch]
                       for who, channels in signals.items() if box.name in channels}
            for a, b in pairs:
                if a in limited and b in limited:
                    pair = (a, limited[a]), (b, limited[b])
                    lines += comparison.errors(quantity, box.name, *pair, distance, found.band)
                    lines += comparison.section_errors(
                        quantity, box.name, *pair,
                        found.samples.position[found.stretch] + box.offset, section_length)
    return lines
