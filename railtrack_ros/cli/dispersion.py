"""Command `railtrack dispersion`."""

from __future__ import annotations

import argparse

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome

EXAMPLE = (
    'railtrack dispersion --track blanco_table_3_1 --frequencies 5:2500:5\n'
    '      --output dispersion.csv --plot dispersion.png'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_track(parser)
    common.add_frequencies(parser)
    common.add_output(
        parser, 'CSV', 'frequency_hz, then real and imaginary part [1/m] of the Bloch wavenumbers '
        'of two waves exp(i(omega t - kappa x)): wave_1 reaches further, wave_2 is the near field')
    common.add_plot(parser)
    common.add_track_options(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Compute the wavenumbers."""
    from railtrack_ros.dynamics.dispersion import DECIBELS, bloch_wavenumbers
    from railtrack_ros.dynamics.receptance import checked_frequencies
    from railtrack_ros.output import write_csv
    from railtrack_ros.report import curves

    if args.plot:
        curves.check_format(args.plot)
    track = common.track(args)
    frequencies = checked_frequencies(args.frequencies)
    kappa = bloch_wavenumbers(track, frequencies)
    write_csv(args.output, {
        'frequency_hz': frequencies,
        'wave_1_real_per_m': kappa[:, 0].real, 'wave_1_imag_per_m': kappa[:, 0].imag,
        'wave_2_real_per_m': kappa[:, 1].real, 'wave_2_imag_per_m': kappa[:, 1].imag,
    })
    if args.plot:
        curves.draw_dispersion(args.plot, frequencies, kappa, track.support.spacing,
                               f'Bloch waves of {track.name}, {track.support.kind} supports')
    decay = -DECIBELS * kappa[:, 0].imag
    least = int(decay.argmin())
    summary = {
        'track': track.name, 'support': track.support.kind, 'frequencies': frequencies.size,
        'least_decay_db_per_m': decay[least], 'least_decay_at_hz': frequencies[least],
        'output': args.output, 'plot': args.plot,
    }
    lines = [
        f'{track.name}, {track.support.kind} supports: {frequencies.size} frequencies',
        f'wave 1 reaches furthest at {frequencies[least]:g} Hz: {decay[least]:.3g} dB/m',
        *common.written(args),
    ]
    return Outcome(summary, lines)
