"""Measurements of other systems into recordings: units, a time base, blocks.

Samples come by time, by a fixed sample rate, or by track position as measuring trains record them.
Position becomes time through the speed, dt = dx/v (trapezoidal in v). Wherever the samples
are then uniform they are taken as they are; where the speed varies, those of equal distance are
not of equal time, and they are resampled at the highest rate that occurs, so that
nothing is aliased. A gap begins a new block at its own time, and a missing value stays NaN.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from railtrack_ros.bags.codec import SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.columns import (
    PIECE,
    Column,
    Even,
    Folder,
    Part,
    Scaled,
    Stored,
    Thinned,
    pieces,
)
from railtrack_ros.bags.import_settings import (
    ACCELERATION_UNITS,
    POSITION_UNITS,
    SPEED_UNITS,
    Calibration,
    ImportSettings,
    facts_of,
)
from railtrack_ros.bags.signals import Decimated, without_high_pass
from railtrack_ros.bags.stretches import SHORTEST, Stretch, equalised, parts, stretch_of
from railtrack_ros.bags.tables import defects, read_columns, sample_rate
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, FRAME, Recording
from railtrack_ros.errors import InputError

BLOCK_DURATION = 0.01  # s, about; a power of two of samples
SMALLEST_BLOCK = 8
# The speed is written from this much before each stretch on, so that it is known at its start.
SPEED_LEAD = (0.1, 0.05)

PLAUSIBLE_RATE = (20.0, 1e6)  # Hz
FASTEST = 200.0  # m/s


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
    summary = ImportSummary()
    with Recording(output, inputs=[path]) as recording, _folder(recording.path) as folder:
        stretches = _stretches(path, settings, folder, summary, lambda x: progress(0.5 * x))
        facts: dict[str, Any] = {'source': path.name, **facts_of(settings)}
        if summary.start_position is not None:
            facts['start_position'] = summary.start_position
        total = sum(stretch.size for stretch in stretches)
        recording.write_facts(facts)
        for stretch in stretches:
            for block, speed in _blocks(stretch, summary):
                if block.stamp_ns == _stamp(stretch.first):
                    for lead in SPEED_LEAD:
                        recording.write_speed(_stamp(stretch.first - lead), speed)
                recording.write_speed(block.stamp_ns, speed)
                recording.write_waveform(ACCELERATION_TOPIC, block)
                summary.blocks += 1
                summary.samples += block.samples
                if summary.blocks % 1000 == 0:
                    progress(0.5 + 0.5 * summary.samples / total)
        for name, missing in summary.missing.items():
            if missing:
                summary.notes.append(f'{path}: channel {name}: {missing} samples have no value')
    progress(1.0)
    return summary


@contextlib.contextmanager
def _folder(output: Path) -> Iterator[Folder]:
    """Give a folder beside the output for columns; it is removed at the end."""
    beside = output.expanduser().resolve().parent
    with tempfile.TemporaryDirectory(prefix=f'.{output.name}.', dir=beside) as name:
        folder = Folder(Path(name))
        try:
            yield folder
        except OSError as error:
            raise InputError(f'{output}: cannot be written ({error.strerror or error})') from error
        finally:
            folder.close()


def _stretches(
    path: Path, settings: ImportSettings, folder: Folder, summary: ImportSummary,
    progress: Callable[[float], None],
) -> list[Stretch]:  # fmt: skip
    """Return the samples of a file in uniform stretches, and add what there is to say of them."""
    wanted = [
        *settings.channels,
        *(settings.time_column, settings.position_column, settings.speed_column),
    ]
    columns = {x: folder.column() for x in wanted if x is not None}
    known = dict.fromkeys(columns, False)
    for piece in read_columns(path, columns, progress):
        for name, values in piece.items():
            columns[name].append(values)
            known[name] = known[name] or bool(np.isfinite(values).any())
    count = next(iter(columns.values())).size
    if count < SHORTEST:
        raise InputError(f'{path}: {count} rows, expected a waveform of at least {SHORTEST}')
    summary.notes += defects(path)
    speed, extremes = _speed(path, settings, columns, count, folder)
    time = _time(path, settings, columns, speed, extremes, summary, folder)
    unit = ACCELERATION_UNITS[settings.acceleration_unit]
    channels: dict[str, Column] = {}
    for column, name in settings.channels.items():
        if not known[column]:
            raise InputError(f'{path}: column {column!r} holds no numbers')
        calibration = settings.calibration.get(name, Calibration())
        channels[name] = Scaled(columns[column], calibration.offset, unit * calibration.factor)
    stretches = []
    dropped = 0
    for start, stop in parts(time):
        if stop - start < SHORTEST:
            dropped += stop - start
            continue
        cut: dict[str, Column] = {
            name: Part(samples, start, stop) for name, samples in channels.items()}
        stretches.append(stretch_of(Part(time, start, stop), Part(speed, start, stop), cut))
    if not stretches:
        raise InputError(f'{path}: no {SHORTEST} samples without a gap; expected a waveform')
    if dropped:
        summary.notes.append(f'{path}: {dropped} samples dropped, single ones between gaps')
    stretches, summary.resampled = equalised(path, stretches)
    stretches = [_conditioned(path, stretch, settings, folder) for stretch in stretches]
    _describe(path, stretches, summary)
    return stretches


def _speed(
    path: Path, settings: ImportSettings, columns: Mapping[str, Column], count: int, folder: Folder
) -> tuple[Column, tuple[float, float]]:
    """Return the speed [m/s] at every sample, empty fields filled linearly, and its extremes."""
    factor = SPEED_UNITS[settings.speed_unit]
    speed: Column
    if settings.speed_column is None:
        assert settings.speed is not None
        value = settings.speed * factor
        speed, where = Even(count, 0.0, value), '--speed'
    else:
        where = f'column {settings.speed_column!r}'
        speed = _filled(Scaled(columns[settings.speed_column], 0.0, factor), folder.column())
        if not speed.size:
            raise InputError(f'{path}: {where} holds no numbers')
    lowest, highest = math.inf, -math.inf
    for part in pieces(count):
        values = speed[part]
        for wrong, why in ((values < 0.0, 'negative'), (values > FASTEST, 'too fast')):
            if wrong.any():
                row = int(wrong.argmax())
                raise InputError(f'{path}: {where}: {values[row]:g} m/s at row '
                                 f'{part.start + row + 1} is {why}; see --speed-unit')
        lowest, highest = min(lowest, values.min()), max(highest, values.max())
    return speed, (lowest, highest)


def _filled(column: Column, result: Stored) -> Stored:
    """Fill what is missing in a column linearly between its neighbours; empty without any."""
    row, last, waiting = -1, math.nan, 0  # the last known one, and how many wait behind it
    for part in pieces(column.size):
        values = column[part]
        known = np.flatnonzero(np.isfinite(values))
        if not known.size:
            waiting += values.size
            continue
        rows, there = part.start + known, values[known]
        if math.isnan(last):
            last = float(there[0])
        for some in pieces(waiting):
            result.append(np.interp(part.start - waiting + np.arange(some.start, some.stop),
                                    [row, rows[0]], [last, there[0]]))
        end = int(known[-1]) + 1
        result.append(np.interp(np.arange(part.start, part.start + end),
                                np.append(row, rows), np.append(last, there)))
        row, last, waiting = int(rows[-1]), float(there[-1]), values.size - end
    if not math.isnan(last):
        for some in pieces(waiting):
            result.append(np.full(some.stop - some.start, last))
    return result


def _time(
    path: Path, settings: ImportSettings, columns: Mapping[str, Column], speed: Column,
    extremes: tuple[float, float], summary: ImportSummary, folder: Folder,
) -> Column:  # fmt: skip
    """Return the time [s] of every sample after the first one."""
    rate = settings.sample_rate
    if rate is None and settings.time_column is None and settings.position_column is None:
        rate = sample_rate(path)
        if rate is None:
            raise InputError(f'{path}: does not tell its sample rate; give one of --sample-rate, '
                             '--time-column, --position-column')
    if rate is not None:
        return Even(speed.size, 1.0 / rate)
    if settings.time_column is not None:
        time = columns[settings.time_column]
        _check_increasing(path, settings.time_column, time, '--sample-rate takes its place')
        return Scaled(time, float(time[0:1][0]), 1.0)
    assert settings.position_column is not None
    column = settings.position_column
    position = Scaled(columns[column], 0.0, POSITION_UNITS[settings.position_unit])
    _check_increasing(path, column, position, 'the track position must grow with the run')
    if extremes[0] == 0.0:
        row = next(part.start + int((speed[part] == 0.0).argmax()) + 1
                   for part in pieces(speed.size) if not speed[part].all())
        raise InputError(f'{path}: the speed is zero at row {row}, so position tells no time')
    first = summary.start_position = float(position[0:1][0])
    if extremes[0] == extremes[1]:
        return Scaled(position, first, 1.0 / extremes[0])
    time, now = folder.column(), 0.0
    time.append(np.zeros(1))
    for part in pieces(position.size - 1):
        around = slice(part.start, part.stop + 1)
        v = speed[around]
        steps = 2.0 * np.diff(position[around]) / (v[1:] + v[:-1])
        steps[0] += now
        reached = np.cumsum(steps)
        now = float(reached[-1])
        time.append(reached)
    return time


def _check_increasing(path: Path, column: str, values: Column, remedy: str) -> None:
    """Refuse a time or position that is missing or does not increase."""
    for part in pieces(values.size):
        here = values[max(part.start - 1, 0):part.stop]
        before = max(part.start - 1, 0)
        bad = ~np.isfinite(here)
        if bad.any():
            row = before + int(bad.argmax()) + 1
            raise InputError(f'{path}: column {column!r} has no value at row {row}')
        falls = np.flatnonzero(np.diff(here) <= 0.0)
        if falls.size:
            row = int(falls[0])
            raise InputError(
                f'{path}: column {column!r} does not increase at row {before + row + 2} '
                f'({here[row]:.10g}, then {here[row + 1]:.10g}); {remedy}')


def _conditioned(
    path: Path, stretch: Stretch, settings: ImportSettings, folder: Folder
) -> Stretch:
    """Return a stretch with the sensors' high-pass undone, and decimated."""
    undone, factor = settings.undo_high_pass, settings.decimate
    if undone is not None:
        if undone.frequency > 0.1 / stretch.step:
            raise InputError(f'{path}: --undo-high-pass {undone}: above a tenth of the sample '
                             f'rate of {1.0 / stretch.step:.6g} Hz')
        stretch = replace(stretch, channels={
            name: without_high_pass(samples, stretch.step, undone.frequency, undone.order,
                                    undone.lowest, folder.column())
            for name, samples in stretch.channels.items()})
    if factor == 1:
        return stretch
    if stretch.size < SHORTEST * factor:
        raise InputError(f'{path}: --decimate {factor}: a stretch of {stretch.size} samples '
                         f'is too short for that, it takes {SHORTEST * factor}')
    return replace(
        stretch, time=Thinned(stretch.time, factor), speed=Thinned(stretch.speed, factor),
        step=stretch.step * factor,
        channels={name: Decimated(x, factor) for name, x in stretch.channels.items()})


def _describe(path: Path, stretches: list[Stretch], summary: ImportSummary) -> None:
    """Fill in the figures of the stretches, and what is wrong with them."""
    summary.sample_rate = 1.0 / stretches[0].step
    if not PLAUSIBLE_RATE[0] <= summary.sample_rate <= PLAUSIBLE_RATE[1]:
        raise InputError(
            f'{path}: the sample rate comes out as {summary.sample_rate:.4g} Hz; '
            'check the units of time, position and speed'
        )
    summary.duration = stretches[-1].last - stretches[0].first
    for stretch in stretches:
        for part in pieces(stretch.size - 1):
            around = slice(part.start, part.stop + 1)
            speed = stretch.speed[around]
            summary.distance += float(
                np.sum(0.5 * (speed[1:] + speed[:-1]) * np.diff(stretch.time[around])))
    for before, after in zip(stretches, stretches[1:], strict=False):
        speeds = before.speed[before.size - 1:before.size][0] + after.speed[0:1][0]
        summary.distance += 0.5 * float(speeds) * (after.first - before.last)
    summary.gaps = len(stretches) - 1
    if summary.gaps:
        lengths = [b.first - a.last for a, b in zip(stretches, stretches[1:], strict=False)]
        summary.notes.append(
            f'{path}: {summary.gaps} gaps, {sum(lengths):.4g} s in all, the first '
            f'at {stretches[0].last:.4g} s'
        )


def _blocks(stretch: Stretch, summary: ImportSummary) -> Iterator[tuple[WaveformBlock, float]]:
    """Yield the blocks of a stretch, each with the speed [m/s] at its first sample.

    Missing samples are counted in the summary.
    """
    step, first = stretch.step, stretch.first
    size = max(SMALLEST_BLOCK, 2 ** round(math.log2(BLOCK_DURATION / step)))
    for piece in pieces(stretch.size, size * max(PIECE // size, 1)):
        speed = stretch.speed[piece]
        channels = {name: column[piece] for name, column in stretch.channels.items()}
        for name, samples in channels.items():
            summary.missing[name] = summary.missing.get(name, 0) + int(np.isnan(samples).sum())
        for part in pieces(piece.stop - piece.start, size):
            yield (
                WaveformBlock(
                    _stamp(first + (piece.start + part.start) * step),
                    step * np.arange(part.stop - part.start),
                    {name: samples[part] for name, samples in channels.items()},
                    frame_id=FRAME,
                ),
                float(speed[part.start]),
            )


def _stamp(time: float) -> int:
    """Return the stamp [ns] of a time [s] after the first sample."""
    return START_NS + round(time * SECOND)
