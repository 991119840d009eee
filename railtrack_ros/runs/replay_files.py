"""What a replay leaves on disk beside its report: samples and errors as CSV, waveforms as MCAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.bags.codec import SECOND, WaveformBlock
from railtrack_ros.bags.writer import Recording
from railtrack_ros.output import write_csv
from railtrack_ros.runs.replay_model import Channels, Replayed
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

# Column stem, unit and decimals (1e-11 m, 0.01 N) of each quantity.
COLUMNS = {
    'contact_force': ('contact_force_{}_n', 2),
    'rail_deflection': ('rail_deflection_{}_m', 11),
    'axle_box_acceleration': ('axle_box_acceleration_{}_m_s2', 5),
    'irregularity': ('irregularity_{}_m', 11),
}
BLOCK = 0.1              # s of waveform in a message


def write_comparison(path: Path, found: Replayed, vehicle: Vehicle) -> int:
    """Write all signals over the stretch, an axle box after the other; returns the lines.

    Signals are low-passed at the upper end of the band, with their static part; lines come as
    seldom as that allows.
    """
    part = slice(found.stretch.start, found.stretch.stop, found.band.every)
    index = np.arange(found.samples.position.size)[part]
    time = np.round(found.samples.start_time + found.samples.time_step * index, 7)
    columns: dict[str, list[Array]] = {name: [] for name in ('time_s', 'axle_box', 'position_m')}
    for box in vehicle.axle_boxes:
        columns['time_s'].append(time)
        columns['axle_box'].append(np.full(index.size, box.name, dtype=object))
        columns['position_m'].append(np.round(found.samples.position[part] + box.offset, 5))
        for quantity, (name, decimals) in COLUMNS.items():
            for who, channels in found.signals(quantity).items():
                values = channels.get(box.name)
                values = (np.full(index.size, np.nan) if values is None
                          else np.round(found.band.low_pass(values)[part], decimals))
                columns.setdefault(name.format(who), []).append(values)
    write_csv(path, {name: np.concatenate(values).tolist() for name, values in columns.items()})
    return index.size * len(vehicle.axle_boxes)


def write_errors(path: Path, found: Replayed) -> None:
    """Write the error table, a line per quantity, axle box, pair and band."""
    write_csv(path, {
        'quantity': [e.quantity for e in found.errors],
        'axle_box': [e.axle_box for e in found.errors],
        'compared': [e.compared for e in found.errors],
        'reference': [e.reference for e in found.errors],
        'band': [e.band for e in found.errors],
        'frequency_hz': [_digits(e.frequency) for e in found.errors],
        'wavelength_m': [_digits(e.wavelength) for e in found.errors],
        'rms_compared': [_digits(e.rms_compared) for e in found.errors],
        'rms_reference': [_digits(e.rms_reference) for e in found.errors],
        'rms_difference': [_digits(e.rms_difference) for e in found.errors],
        'level_difference_db': [round(e.level_difference, 4) for e in found.errors],
        'difference_level_db': [round(e.difference_level, 4) for e in found.errors],
    })


def write_waveforms(path: Path, found: Replayed) -> None:
    """Write the full model's answers, and the irregularity that drove it, as waveform topics."""
    samples = found.samples
    size = max(1, round(BLOCK / samples.time_step))
    topics: dict[str, Channels] = {**found.full_model, 'irregularity': found.excitation}
    with Recording(path) as recording:
        for begin in range(found.stretch.start, found.stretch.stop, size):
            part = slice(begin, min(begin + size, found.stretch.stop))
            stamp = samples.start_ns + round(begin * samples.time_step * SECOND)
            t = samples.time_step * np.arange(part.stop - begin)
            for quantity, channels in topics.items():
                block = WaveformBlock(stamp, t, {name: x[part] for name, x in channels.items()},
                                      samples.position[part])
                recording.write_waveform(f'/full_model/{quantity}', block)


def _digits(value: float) -> float:
    return float(f'{value:.6g}')
