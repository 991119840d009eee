"""What a replay leaves on disk beside its report: samples and errors as CSV, waveforms as MCAP."""

from __future__ import annotations

import csv
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from railtrack_ros.bags.codec import SECOND, WaveformBlock
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.writer import Recording
from railtrack_ros.errors import InputError
from railtrack_ros.output import write_csv
from railtrack_ros.runs import configuration
from railtrack_ros.runs.comparison import Error
from railtrack_ros.runs.replay_model import Channels, Replayed
from railtrack_ros.runs.results import CONFIGURATION
from railtrack_ros.vehicle.description import Vehicle

# Column stem, unit and decimals (1e-11 m, 0.01 N) of each quantity.
COLUMNS = {
    'contact_force': ('contact_force_{}_n', 2),
    'rail_deflection': ('rail_deflection_{}_m', 11),
    'axle_box_acceleration': ('axle_box_acceleration_{}_m_s2', 5),
    'irregularity': ('irregularity_{}_m', 11),
}
BLOCK = 0.1              # s of waveform in a message


@contextmanager
def complete_folder(output: Path) -> Iterator[Path]:
    """Give a place to write to; its files move into the folder when all of them are there."""
    new = not output.exists()
    try:
        output.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix='.part.', dir=output))
    except OSError as error:
        raise InputError(f'{output}: cannot be written ({error.strerror or error})') from error
    try:
        yield place
        for file in sorted(place.iterdir()):
            os.replace(file, output / file.name)
    except OSError as error:
        raise InputError(f'{output}: cannot be written ({error.strerror or error})') from error
    finally:
        shutil.rmtree(place, ignore_errors=True)
        if new and not any(output.iterdir()):
            output.rmdir()


class ReplayFiles:
    """The samples of a replay on disk, window after window; use it in a `with` statement.

    ``comparison.csv`` holds all signals over the stretch, in each window an axle box after the
    other: low-passed at the upper end of the band, with their static part, and as seldom as that
    allows. ``replay.mcap`` holds the full model's answers and the irregularity that drove it.
    """

    def __init__(self, folder: Path, vehicle: Vehicle, told: str) -> None:
        """Begin the files; `told` is what they are of, see `runs.configuration`."""
        self._vehicle = vehicle
        self._configuration: str | None = told
        self._recording = Recording(folder / 'replay.mcap')
        self._file = (folder / 'comparison.csv').open('w', encoding='utf-8', newline='')
        self._rows = csv.writer(self._file, lineterminator='\n')
        self._header: list[str] = []

    def add(self, found: Replayed) -> None:
        """Write a window."""
        columns = self._columns(found)
        if not self._header:
            self._header = list(columns)
            self._rows.writerow(self._header)
        empty = [math.nan] * len(columns['time_s'])
        self._rows.writerows(
            ['' if isinstance(value, float) and math.isnan(value) else value for value in row]
            for row in zip(*(columns.get(name, empty) for name in self._header), strict=True))
        self._waveforms(found)

    def __enter__(self) -> ReplayFiles:
        self._recording.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self._file.close()
        self._recording.__exit__(kind, error, traceback)

    def _columns(self, found: Replayed) -> dict[str, list[Any]]:
        part = slice(found.stretch.start, found.stretch.stop, found.band.every)
        index = np.arange(found.samples.position.size)[part]
        time = np.round(found.samples.start_time + found.samples.time_step * index, 7)
        columns: dict[str, list[Any]] = {name: [] for name in ('time_s', 'axle_box', 'position_m')}
        for box in self._vehicle.axle_boxes:
            columns['time_s'] += time.tolist()
            columns['axle_box'] += [box.name] * index.size
            place = found.samples.position[part] + box.offset
            columns['position_m'] += np.round(place, 5).tolist()
            for quantity, (name, decimals) in COLUMNS.items():
                for who, channels in found.signals(quantity).items():
                    values = channels.get(box.name)
                    values = (np.full(index.size, np.nan) if values is None
                              else np.round(found.band.low_pass(values)[part], decimals))
                    columns.setdefault(name.format(who), []).extend(values.tolist())
        return columns

    def _waveforms(self, found: Replayed) -> None:
        samples = found.samples
        size = max(1, round(BLOCK / samples.time_step))
        if self._configuration is not None:
            message = OFFLINE.get(configuration.TYPE)(data=self._configuration)
            self._recording.write(f'/full_model/{CONFIGURATION}', message, samples.start_ns)
            self._configuration = None
        topics: dict[str, Channels] = {**found.full_model, 'irregularity': found.excitation}
        for begin in range(found.stretch.start, found.stretch.stop, size):
            part = slice(begin, min(begin + size, found.stretch.stop))
            stamp = samples.start_ns + round(begin * samples.time_step * SECOND)
            t = samples.time_step * np.arange(part.stop - begin)
            for quantity, channels in topics.items():
                block = WaveformBlock(stamp, t, {name: x[part] for name, x in channels.items()},
                                      samples.position[part])
                self._recording.write_waveform(f'/full_model/{quantity}', block)


def write_errors(path: Path, errors: Sequence[Error]) -> None:
    """Write the error table, a line per quantity, axle box, pair and band."""
    write_csv(path, {
        'quantity': [e.quantity for e in errors],
        'axle_box': [e.axle_box for e in errors],
        'compared': [e.compared for e in errors],
        'reference': [e.reference for e in errors],
        'band': [e.band for e in errors],
        'frequency_hz': [_digits(e.frequency) for e in errors],
        'wavelength_m': [_digits(e.wavelength) for e in errors],
        'rms_compared': [_digits(e.rms_compared) for e in errors],
        'rms_reference': [_digits(e.rms_reference) for e in errors],
        'rms_difference': [_digits(e.rms_difference) for e in errors],
        'level_difference_db': [round(e.level_difference, 4) for e in errors],
        'difference_level_db': [round(e.difference_level, 4) for e in errors],
        'coherence': [_digits(e.coherence) for e in errors],
        'from_m': [e.begin for e in errors],
        'to_m': [e.end for e in errors],
    })


def _digits(value: float) -> float:
    return float(f'{value:.6g}')
