"""Measurements of other systems into recordings: units, a time base, blocks.

Samples come by time, by a fixed sample rate, or by track position as measuring trains record them.
Position becomes time through the speed, dt = dx/v (trapezoidal in v). Wherever the samples
are then uniform they are taken as they are; where the speed varies, those of equal distance are
not of equal time, and they are resampled at the highest rate that occurs, so that
nothing is aliased. A gap begins a new block at its own time, and a missing value stays NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import median_filter

from railtrack_ros.bags.codec import SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.import_settings import (
    ACCELERATION_UNITS,
    POSITION_UNITS,
    SPEED_UNITS,
    Calibration,
    ImportSettings,
    facts_of,
)
from railtrack_ros.bags.signals import decimated, without_high_pass
from railtrack_ros.bags.tables import defects, read_columns, sample_rate
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, FRAME, Recording
from railtrack_ros.errors import InputError

Array = NDArray[np.float64]

BLOCK_DURATION = 0.01  # s, about; a power of two of samples
SMALLEST_BLOCK = 8
# The speed is written from this much before each stretch on, so that it is known at its start.
SPEED_LEAD = (0.1, 0.05)

# A step that is longer than its neighbours by this factor is a gap.
GAP = 1.5
# Samples may lie this part of a sample period off a uniform grid and still count as uniform.
UNIFORMITY = 0.1
# Sample periods of different stretches that differ by more than this part are different rates.
SAME_RATE = 1e-3
# Resampling may make this many times the samples, as a run from walking pace to full speed does.
MOST_ADDED = 50.0
# Shorter stretches between gaps hold nothing that could be used.
SHORTEST = 16

PLAUSIBLE_RATE = (20.0, 1e6)  # Hz
FASTEST = 200.0  # m/s


@dataclass(frozen=True)
class Stretch:
    """Samples without a gap: times (n,) [s], speed (n,) [m/s], channels (n,) [m/s^2]."""

    time: Array
    speed: Array
    channels: dict[str, Array]

    @property
    def step(self) -> float:
        """Return the mean sample period [s]."""
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    @property
    def uniform(self) -> bool:
        """Return whether all samples lie on a uniform grid, as far as anyone could tell."""
        grid = self.time[0] + self.step * np.arange(self.time.size)
        return bool(np.abs(self.time - grid).max() <= UNIFORMITY * self.step)


@dataclass
class ImportSummary:
    """What was imported; SI units, `missing` counts samples without a value per channel."""

    samples: int = 0
    blocks: int = 0
    sample_rate: float = math.nan
    duration: float = 0.0
    distance: float = 0.0
    start_position: float | None = None
    resampled: bool = False
    gaps: int = 0
    missing: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def import_measurement(
    path: str | Path,
    output: str | Path,
    settings: ImportSettings,
    progress: Callable[[float], None] = lambda part: None,
) -> ImportSummary:
    """Turn a file of another system, of the kinds that `tables` reads, into a recording.

    The recording begins at a fixed time, so that the same file always gives the same recording.
    Where the file tells the track position, that of the first sample is written
    as the fact `start_position` [m].

    Parameters
    ----------
    path, output
        The file, and the recording to write: `NAME.mcap` or a rosbag2 folder.
    settings
        Columns and units.
    progress
        Called with the part of the work that is done, 0 to 1.

    Raises
    ------
    InputError
        The file cannot be read or understood; the message names file, column and row.
    """
    path = Path(path)
    stretches, summary = _stretches(path, settings, lambda part: progress(0.5 * part))
    facts: dict[str, Any] = {'source': path.name, **facts_of(settings)}
    if summary.start_position is not None:
        facts['start_position'] = summary.start_position
    total = sum(stretch.time.size for stretch in stretches)
    with Recording(output, inputs=[path]) as recording:
        recording.write_facts(facts)
        for stretch in stretches:
            for block, speed in _blocks(stretch):
                if block.stamp_ns == _stamp(stretch.time[0]):
                    for lead in SPEED_LEAD:
                        recording.write_speed(_stamp(stretch.time[0] - lead), speed)
                recording.write_speed(block.stamp_ns, speed)
                recording.write_waveform(ACCELERATION_TOPIC, block)
                summary.blocks += 1
                summary.samples += block.samples
                if summary.blocks % 1000 == 0:
                    progress(0.5 + 0.5 * summary.samples / total)
    progress(1.0)
    return summary


def _stretches(
    path: Path, settings: ImportSettings, progress: Callable[[float], None]
) -> tuple[list[Stretch], ImportSummary]:
    """Return the samples of a file in uniform stretches, and what there is to say of them."""
    wanted = [
        *settings.channels,
        *(settings.time_column, settings.position_column, settings.speed_column),
    ]
    columns = read_columns(path, dict.fromkeys(x for x in wanted if x is not None), progress)
    count = next(iter(columns.values())).size
    if count < SHORTEST:
        raise InputError(f'{path}: {count} rows, expected a waveform of at least {SHORTEST}')
    summary = ImportSummary(notes=defects(path))
    speed = _speed(path, settings, columns, count)
    time = _time(path, settings, columns, speed, summary)
    unit = ACCELERATION_UNITS[settings.acceleration_unit]
    channels = {}
    for column, name in settings.channels.items():
        calibration = settings.calibration.get(name, Calibration())
        samples = (columns[column] - calibration.offset) * (unit * calibration.factor)
        samples[~np.isfinite(samples)] = np.nan
        if np.isnan(samples).all():
            raise InputError(f'{path}: column {column!r} holds no numbers')
        channels[name] = samples

    stretches = []
    dropped = 0
    for part in _parts(time):
        if part.stop - part.start < SHORTEST:
            dropped += part.stop - part.start
            continue
        cut = {name: samples[part] for name, samples in channels.items()}
        stretches.append(Stretch(time[part], speed[part], cut))
    if not stretches:
        raise InputError(f'{path}: no {SHORTEST} samples without a gap; expected a waveform')
    if dropped:
        summary.notes.append(f'{path}: {dropped} samples dropped, single ones between gaps')
    stretches = _equalised(path, stretches, summary)
    stretches = [_conditioned(path, stretch, settings) for stretch in stretches]
    _describe(path, stretches, summary)
    return stretches, summary


def _speed(path: Path, settings: ImportSettings, columns: Mapping[str, Array], count: int) -> Array:
    """Return the speed (n,) [m/s] at every sample; empty fields are filled linearly."""
    factor = SPEED_UNITS[settings.speed_unit]
    speed: Array
    if settings.speed_column is None:
        assert settings.speed is not None
        speed = np.full(count, settings.speed * factor)
        where = '--speed'
    else:
        where = f'column {settings.speed_column!r}'
        speed = columns[settings.speed_column] * factor
        known = np.isfinite(speed)
        if not known.any():
            raise InputError(f'{path}: {where} holds no numbers')
        speed = np.interp(np.arange(count), np.flatnonzero(known), speed[known])
    for wrong, why in ((speed < 0.0, 'negative'), (speed > FASTEST, 'too fast')):
        if wrong.any():
            row = int(wrong.argmax())
            raise InputError(
                f'{path}: {where}: {speed[row]:g} m/s at row {row + 1} is {why}; see --speed-unit'
            )
    return speed


def _time(
    path: Path,
    settings: ImportSettings,
    columns: Mapping[str, Array],
    speed: Array,
    summary: ImportSummary,
) -> Array:
    """Return the time (n,) [s] of every sample after the first one."""
    rate = settings.sample_rate
    if rate is None and settings.time_column is None and settings.position_column is None:
        rate = sample_rate(path)
        if rate is None:
            raise InputError(f'{path}: does not tell its sample rate; give one of --sample-rate, '
                             '--time-column, --position-column')
    if rate is not None:
        return np.arange(speed.size) / rate
    if settings.time_column is not None:
        time = columns[settings.time_column]
        _check_increasing(path, settings.time_column, time, '--sample-rate takes its place')
        return time - time[0]
    assert settings.position_column is not None
    column = settings.position_column
    position = columns[column] * POSITION_UNITS[settings.position_unit]
    _check_increasing(path, column, position, 'the track position must grow with the run')
    if not speed.all():
        row = int((speed == 0.0).argmax()) + 1
        raise InputError(f'{path}: the speed is zero at row {row}, so position tells no time')
    summary.start_position = float(position[0])
    if np.ptp(speed) == 0.0:
        return (position - position[0]) / speed[0]
    steps = 2.0 * np.diff(position) / (speed[1:] + speed[:-1])
    return np.concatenate(([0.0], np.cumsum(steps)))


def _check_increasing(path: Path, column: str, values: Array, remedy: str) -> None:
    """Refuse a time or position that is missing or does not increase."""
    bad = ~np.isfinite(values)
    if bad.any():
        row = int(bad.argmax()) + 1
        raise InputError(f'{path}: column {column!r} has no value at row {row}')
    steps = np.diff(values)
    if (steps <= 0.0).any():
        row = int((steps <= 0.0).argmax())
        raise InputError(
            f'{path}: column {column!r} does not increase at row {row + 2} '
            f'({values[row]:.10g}, then {values[row + 1]:.10g}); {remedy}'
        )


def _parts(time: Array) -> Iterator[slice]:
    """Yield the stretches of samples between gaps."""
    steps = np.diff(time)
    usual = median_filter(steps, size=9, mode='nearest')
    cuts = np.flatnonzero(steps > GAP * usual) + 1
    edges = [0, *cuts.tolist(), time.size]
    for start, stop in zip(edges, edges[1:], strict=False):
        yield slice(start, stop)


def _equalised(path: Path, stretches: list[Stretch], summary: ImportSummary) -> list[Stretch]:
    """Return the stretches at one sample rate: as they are, or resampled where they differ."""
    steps = np.array([stretch.step for stretch in stretches])
    same = np.ptp(steps) <= SAME_RATE * steps.mean()
    if same and all(stretch.uniform for stretch in stretches):
        return stretches
    # The shortest sample period that occurs, single jitters apart.
    step = min(float(median_filter(np.diff(x.time), size=9).min()) for x in stretches)
    before = sum(stretch.time.size for stretch in stretches)
    after = sum((stretch.time[-1] - stretch.time[0]) / step for stretch in stretches)
    if after > MOST_ADDED * before:
        raise InputError(
            f'{path}: the sample period varies so much, from {step:.4g} s on, that resampling '
            f'would make {after / before:.0f} times the samples; import faster stretches alone'
        )
    summary.resampled = True
    return [_resampled(stretch, step) for stretch in stretches]


def _resampled(stretch: Stretch, step: float) -> Stretch:
    """Return a stretch on a uniform grid of time, interpolated by splines of degree 5.

    Between samples next to a missing one nothing is made up: the result is NaN there.
    """
    grid = stretch.time[0] + step * np.arange(
        math.floor((stretch.time[-1] - stretch.time[0]) / step * (1.0 + 1e-12)) + 1
    )
    channels = {}
    for name, samples in stretch.channels.items():
        known = np.isfinite(samples)
        if known.sum() < SHORTEST:
            channels[name] = np.full(grid.size, np.nan)
            continue
        values = make_interp_spline(stretch.time[known], samples[known], k=5)(grid)
        values[np.interp(grid, stretch.time, np.where(known, 0.0, 1.0)) > 0.0] = np.nan
        channels[name] = values
    return Stretch(grid, np.interp(grid, stretch.time, stretch.speed), channels)


def _conditioned(path: Path, stretch: Stretch, settings: ImportSettings) -> Stretch:
    """Return a stretch with the sensors' high-pass undone, and decimated."""
    undone, factor = settings.undo_high_pass, settings.decimate
    channels = dict(stretch.channels)
    if undone is not None:
        if undone.frequency > 0.1 / stretch.step:
            raise InputError(f'{path}: --undo-high-pass {undone}: above a tenth of the sample '
                             f'rate of {1.0 / stretch.step:.6g} Hz')
        channels = {
            name: without_high_pass(x, stretch.step, undone.frequency, undone.order, undone.lowest)
            for name, x in channels.items()}
    if factor == 1:
        return Stretch(stretch.time, stretch.speed, channels)
    if stretch.time.size < SHORTEST * factor:
        raise InputError(f'{path}: --decimate {factor}: a stretch of {stretch.time.size} samples '
                         f'is too short for that, it takes {SHORTEST * factor}')
    return Stretch(stretch.time[::factor], stretch.speed[::factor],
                   {name: decimated(x, factor) for name, x in channels.items()})


def _describe(path: Path, stretches: list[Stretch], summary: ImportSummary) -> None:
    """Fill in the figures of the stretches, and what is wrong with them."""
    summary.sample_rate = 1.0 / stretches[0].step
    if not PLAUSIBLE_RATE[0] <= summary.sample_rate <= PLAUSIBLE_RATE[1]:
        raise InputError(
            f'{path}: the sample rate comes out as {summary.sample_rate:.4g} Hz; '
            'check the units of time, position and speed'
        )
    summary.duration = float(stretches[-1].time[-1] - stretches[0].time[0])
    time = np.concatenate([stretch.time for stretch in stretches])
    speed = np.concatenate([stretch.speed for stretch in stretches])
    summary.distance = float(np.sum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time)))
    summary.gaps = len(stretches) - 1
    if summary.gaps:
        lengths = [b.time[0] - a.time[-1] for a, b in zip(stretches, stretches[1:], strict=False)]
        summary.notes.append(
            f'{path}: {summary.gaps} gaps, {sum(lengths):.4g} s in all, the first '
            f'at {stretches[0].time[-1]:.4g} s'
        )
    for name in stretches[0].channels:
        missing = sum(int(np.isnan(x.channels[name]).sum()) for x in stretches)
        summary.missing[name] = missing
        if missing:
            summary.notes.append(f'{path}: channel {name}: {missing} samples have no value')


def _blocks(stretch: Stretch) -> Iterator[tuple[WaveformBlock, float]]:
    """Yield the blocks of a stretch, each with the speed [m/s] at its first sample."""
    step = stretch.step
    size = max(SMALLEST_BLOCK, 2 ** round(math.log2(BLOCK_DURATION / step)))
    for start in range(0, stretch.time.size, size):
        part = slice(start, min(start + size, stretch.time.size))
        yield (
            WaveformBlock(
                _stamp(stretch.time[0] + start * step),
                step * np.arange(part.stop - part.start),
                {name: samples[part] for name, samples in stretch.channels.items()},
                frame_id=FRAME,
            ),
            float(stretch.speed[start]),
        )


def _stamp(time: float) -> int:
    """Return the stamp [ns] of a time [s] after the first sample."""
    return START_NS + round(time * SECOND)
