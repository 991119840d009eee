"""What a replay found, put into words, key figures and plots for the report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from railtrack_ros import __version__
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.output import metres
from railtrack_ros.report import style
from railtrack_ros.report.content import (
    Card,
    Indicators,
    Latency,
    Report,
    Spectrum,
    Table,
    Tile,
)
from railtrack_ros.runs import comparison, replay_plots
from railtrack_ros.runs.comparison import Error
from railtrack_ros.runs.replay_model import PAIRS, Replayed
from railtrack_ros.runs.replay_plots import NAMES, PLOTS
from railtrack_ros.runs.replay_spectra import spectra
from railtrack_ros.runs.report_parts import corrugation_findings, described_track, worst_tile
from railtrack_ros.track.bay import Mesh
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

UNEXPLAINED = 0.3        # of the measured RMS: a larger difference is not explained
MOST_ROWS = 25           # of a table on the page


@dataclass(frozen=True)
class About:
    """What the report says of a run beyond its results.

    ``findings``, ``tiles`` and ``parameters`` are put beside those of the replay.
    """

    title: str
    subtitle: str
    findings: Sequence[str] = ()
    tiles: Sequence[Tile] = ()
    parameters: Mapping[str, Mapping[str, str]] | None = None


def replay_report(found: Replayed, vehicle: Vehicle, about: About,
                  indicators: Indicators | None = None, latency: Latency | None = None,
                  levels: Mapping[str, Spectrum] | None = None, cards: Sequence[Card] = ()
                  ) -> Report:
    """Compose the report of a replay; without truth, indicators or latency those parts lack.

    levels: spectra of the irregularity over the whole stretch, where `found` shows a window of it.
    cards: further parts of the page.
    """
    window = replay_plots.window(found, vehicle, indicators)
    plots = {quantity: replay_plots.waveforms(found, vehicle, quantity, window)
             for quantity in PLOTS}
    return Report(
        title=about.title,
        subtitle=about.subtitle,
        findings=[*corrugation_findings(indicators), *_agreement(found), *_unexplained(found),
                  *_live(latency), *about.findings],
        tiles=[*_tiles(found, indicators, latency), *about.tiles],
        indicators=indicators,
        irregularity=plots['irregularity'],
        spectra=levels if levels is not None else spectra(found, vehicle),
        spectrum_remark=_spectrum_remark(found),
        waveforms=[plots[q] for q in PAIRS if q != 'irregularity'],
        errors=[replay_plots.error_plot(found, q) for q in (
            'contact_force', 'rail_deflection', 'axle_box_acceleration')],
        tables=[_unexplained_table(found), _table(found, vehicle)],
        latency=latency,
        parameters=about.parameters or {},
        methods=_methods(found),
        highlight=found.compared,
        axle_box=replay_plots.shown(vehicle, indicators),
        cards=cards,
    )


def worst(errors: Iterable[Error], quantity: str, compared: str, reference: str) -> Error | None:
    """Return the one-third octave of frequency with the largest level difference, if any."""
    lines = [e for e in errors if (e.quantity, e.compared, e.reference, e.band) == (
        quantity, compared, reference, 'frequency')]
    return max(lines, key=lambda e: abs(e.level_difference), default=None)


def unexplained(errors: Iterable[Error]) -> list[Error]:
    """Return the sections in which the full model does not explain the measured acceleration.

    That is, where the difference is above `UNEXPLAINED` times the measured RMS within the band;
    neighbouring sections of an axle box are one line, with their mean squares.
    """
    lines = [e for e in errors if e.band == 'section' and e.quantity == 'axle_box_acceleration'
             and e.rms_difference > UNEXPLAINED * e.rms_reference]
    lines.sort(key=lambda e: (e.axle_box, e.begin))
    found: list[Error] = []
    for line in lines:
        last = found[-1] if found else None
        if last is not None and (last.axle_box, last.end) == (line.axle_box, line.begin):
            both = replace(last, begin=math.nan, end=math.nan), replace(
                line, begin=math.nan, end=math.nan)
            found[-1] = replace(comparison.merged([both])[0], begin=last.begin, end=line.end)
        else:
            found.append(line)
    return sorted(found, key=lambda e: -e.difference_level)


def overall(errors: Iterable[Error], quantity: str, compared: str, reference: str
            ) -> tuple[float, float] | None:
    """Return RMS difference and RMS reference over all axle boxes, None if not compared."""
    lines = [e for e in errors if (e.quantity, e.compared, e.reference, e.band) == (
        quantity, compared, reference, 'all')]
    if not lines:
        return None
    return (float(np.sqrt(np.mean([e.rms_difference**2 for e in lines]))),
            float(np.sqrt(np.mean([e.rms_reference**2 for e in lines]))))


# In words


def _agreement(found: Replayed) -> list[str]:
    band = f'from {_hertz(found.band.low)} to {_hertz(found.band.high)}'
    begin, end = found.compared
    texts = []
    model = worst(found.errors, 'axle_box_acceleration', 'full_model', 'measured')
    if model is not None:
        difference, reference = _overall(found, 'axle_box_acceleration', 'full_model', 'measured')
        texts.append(
            f'From {begin:.0f} m to {end:.0f} m the full model, driven by the '
            f'recovered irregularity, repeats the measured axle-box acceleration {band}: '
            f'the difference is {100 * difference / reference:.1f} % of its RMS, and no one-third '
            f'octave of any axle box is off by more than {abs(model.level_difference):.2f} dB '
            f'(at {model.frequency:.0f} Hz).')
    force, lost = _worst_of_truth(found.errors, 'contact_force')
    if force is not None:
        difference, reference = _overall(found, 'contact_force', 'estimated', 'truth')
        texts.append(
            f'The estimated contact force misses the true one by {difference / 1e3:.2f} kN RMS, '
            f'{100 * difference / reference:.1f} % of its dynamic part; the largest error in a '
            f'one-third octave is {abs(force.level_difference):.2f} dB, at {force.frequency:.0f} '
            f'Hz{lost}.')
    shape, lost = _worst_of_truth(found.errors, 'irregularity')
    if shape is not None:
        lines = [e for e in found.errors if e.quantity == 'irregularity' and e.band == 'frequency']
        texts.append(
            f'The true irregularity comes back within {abs(shape.level_difference):.2f} dB in '
            f'every one-third octave from {_millimetres(max(e.wavelength for e in lines))} down '
            f'to {_millimetres(min(e.wavelength for e in lines))} of wavelength{lost}.')
    return texts


def _worst_of_truth(errors: Iterable[Error], quantity: str) -> tuple[Error | None, str]:
    """Return the worst one-third octave in which truth exceeds the difference, and on the others.

    Where there is next to no truth, the estimate is the noise of the sensors. If no one-third
    octave has more truth than difference, the worst one of all is returned.
    """
    lines = [e for e in errors if (e.quantity, e.compared, e.reference, e.band) == (
        quantity, 'estimated', 'truth', 'frequency')]
    seen = [e for e in lines if e.rms_difference <= e.rms_reference]
    lost = len(lines) - len(seen)
    text = (f'; left out are {lost} of {len(lines)}, of all axle boxes, in which the difference '
            'is larger than the true one')
    if not seen:
        return worst(lines, quantity, 'estimated', 'truth'), ''
    return worst(seen, quantity, 'estimated', 'truth'), text if lost else ''


def _unexplained(found: Replayed) -> list[str]:
    lines = unexplained(found.errors)
    if not any(e.quantity == 'axle_box_acceleration' for e in found.errors):
        return []
    if not lines:
        return ['There is no section of track in which the full model leaves more than '
                f'{100 * UNEXPLAINED:.0f} % of the measured acceleration unexplained.']
    first = lines[0]
    text = (f'The full model does not explain the acceleration of {style.box_title(first.axle_box)}'
            f' from {first.begin:.0f} m to {first.end:.0f} m: the difference is '
            f'{100 * first.rms_difference / first.rms_reference:.0f} % of the measured RMS.')
    if len(lines) > 1:
        text += (f' In {len(lines) - 1} more stretch{"es" if len(lines) > 2 else ""} it is above '
                 f'{100 * UNEXPLAINED:.0f} %; a table below lists them.')
    return [text]


def _unexplained_table(found: Replayed) -> Table:
    """List the stretches that the model does not explain."""
    lines = unexplained(found.errors)
    columns = ('axle box', 'from - to [m]', 'measured [m/s²]', 'full model - measured [m/s²]',
               '[dB]')
    rows = [[style.box_title(e.axle_box), f'{e.begin:.0f} - {e.end:.0f}', f'{e.rms_reference:.2f}',
             f'{e.rms_difference:.2f}', f'{e.difference_level:.1f}'] for e in lines[:MOST_ROWS]]
    share = f'{100 * UNEXPLAINED:.0f} %'
    if not lines:
        return Table(f'No section differs by more than {share} of the measured acceleration', (),
                     ())
    return Table('Where the model does not explain the measurement', columns, rows,
                 f'Sections in which the difference of the accelerations is above {share} of the '
                 'measured RMS within the band' + (
                     f'; the {MOST_ROWS} worst of {len(lines)}.' if len(lines) > MOST_ROWS else '.')
                 + ' errors.csv holds every section.')


def _live(latency: Latency | None) -> list[str]:
    if latency is None:
        return []
    share = 100.0 * float(np.mean(latency.delay <= (latency.real_time_limit or np.inf)))
    within = '' if latency.real_time_limit is None else (
        f', {share:.3g} % of them within the {1e3 * latency.real_time_limit:.3g} ms that a block '
        'lasts')
    return [f'Live results came {1e3 * float(np.median(latency.delay)):.1f} ms after their block '
            f'in the median and {1e3 * float(np.percentile(latency.delay, 99)):.1f} ms at the 99th '
            f'percentile{within}.']


def _tiles(found: Replayed, indicators: Indicators | None, latency: Latency | None
           ) -> list[Tile]:
    begin, end = found.compared
    slowest, mean, fastest = found.extent.speeds
    tiles = [Tile('replayed stretch', f'{end - begin:.0f} m',
                  f'at {slowest:.1f} to {fastest:.1f} m/s'
                  if fastest - slowest > 0.05 else f'at {mean:.1f} m/s')]
    tiles += worst_tile(indicators)
    for quantity, pair, label, who in (
            ('axle_box_acceleration', ('full_model', 'measured'), 'full model error',
             'acceleration, against measured'),
            ('contact_force', ('estimated', 'truth'), 'contact force error',
             'estimated against true'),
            ('irregularity', ('estimated', 'truth'), 'irregularity error',
             'estimated against true')):
        error = (worst(found.errors, quantity, *pair) if pair[1] != 'truth'
                 else _worst_of_truth(found.errors, quantity)[0])
        if error is not None:
            tiles.append(Tile(label, f'{abs(error.level_difference):.2f} dB',
                              f'worst one-third octave, {who}'))
    if latency is not None:
        tiles.append(Tile('live latency', f'{1e3 * float(np.median(latency.delay)):.1f} ms',
                          f'median; 99 % within '
                          f'{1e3 * float(np.percentile(latency.delay, 99)):.1f} ms'))
    return tiles


def _spectrum_remark(found: Replayed) -> str:
    return ('Combined irregularity of wheel and rail over the replayed stretch, as the estimator '
            'publishes it; only the wavelengths that speed, sample rate and high-pass resolve. '
            'The limit is that of ISO 3095 for rails of test tracks, for orientation.'
            + (' Below: level of the estimated minus that of the true one, which has passed the '
               'same high-pass.' if found.truth_irregularity else ''))


def _methods(found: Replayed) -> list[str]:
    return [
        'The irregularity that the estimator recovers for each wheel is causally high-passed '
        '(Butterworth of order 4 in wavelength). Before it drives the full model it passes the '
        'same filter backwards, which removes the phase. The model gives the static load and the '
        'dynamics above the cut-on; it starts ahead of the stretch, so that its transients have '
        'died away.',
        f'Errors are taken within a band that both sides describe: {found.band.describe()}. '
        'Curves are low-passed in the same way, with their static part. Level differences are '
        'of one-third octaves from averaged Hann-weighted spectra of the compared signals.',
    ]


def parameters(track: Track, mesh: Mesh, vehicle: Vehicle, settings: EstimatorSettings,
               found: Replayed) -> dict[str, dict[str, str]]:
    """Return what the results depend on, in groups, for the record."""
    return {
        'software': {'version': f'railtrack_ros {__version__}'},
        **described_track(track, vehicle),
        'estimator': {
            'start position': f'{metres(settings.start_position)} m',
            'high-pass of the irregularity': f'{settings.cut_on_wavelength:g} m',
            'track modes up to': f'{settings.maximum_frequency:g} Hz',
            'mesh': f'{settings.elements_per_bay} elements a bay, {settings.local_system} local '
                    f'system, ring of {settings.bays_in_ring} bays',
        },
        'full model': {
            'mesh': f'{mesh.elements_per_bay} elements a bay, {mesh.local_system} local system',
            'time step': f'{1e6 * found.model_step:.4g} µs',
            'sample rate of the data': f'{1.0 / found.samples.time_step:.6g} Hz',
            'compared': f'{found.band.low:.4g} to {found.band.high:.4g} Hz',
        },
    }


def _table(found: Replayed, vehicle: Vehicle) -> Table:
    """RMS within the band, and of the differences, per axle box."""
    shown = [('contact_force', 'estimated', 1e-3, 'kN', 2),
             ('rail_deflection', 'estimated', 1e6, 'µm', 2),
             ('axle_box_acceleration', 'measured', 1.0, 'm/s²', 2)]
    shown_truth = [('contact_force', 1e-3, 'kN', 3), ('irregularity', 1e6, 'µm', 2)]
    lines = {(e.quantity, e.axle_box, e.compared, e.reference): e
             for e in found.errors if e.band == 'all'}
    columns, rows = ['axle box'], []
    for quantity, reference, _, unit, _ in shown:
        columns += [f'{PLOTS[quantity][1]} {NAMES[reference]} [{unit}]',
                    f'full model - {NAMES[reference]} [{unit}]', '[dB]']
    with_truth = any(key[3] == 'truth' for key in lines)
    if with_truth:
        columns += [f'{PLOTS[q][1]}: estimated - true [{unit}]' for q, _, unit, _ in shown_truth]
    for box in vehicle.axle_boxes:
        row = [style.box_title(box.name)]
        for quantity, reference, scale, _, digits in shown:
            e = lines.get((quantity, box.name, 'full_model', reference))
            row += ['', '', ''] if e is None else [
                f'{e.rms_reference * scale:.{digits}f}', f'{e.rms_difference * scale:.{digits}f}',
                f'{e.difference_level:.1f}']
        if with_truth:
            for quantity, scale, _, digits in shown_truth:
                e = lines.get((quantity, box.name, 'estimated', 'truth'))
                row.append('' if e is None else f'{e.rms_difference * scale:.{digits}f}')
        rows.append(row)
    return Table('RMS within the band, per axle box', columns, rows,
                 'dB: level of the difference relative to the signal.')


def _overall(found: Replayed, quantity: str, compared: str, reference: str
             ) -> tuple[float, float]:
    result = overall(found.errors, quantity, compared, reference)
    assert result is not None
    return result


def _hertz(frequency: float) -> str:
    return f'{frequency:.0f} Hz' if frequency < 1000 else f'{frequency / 1e3:.1f} kHz'


def _millimetres(wavelength: float) -> str:
    return f'{wavelength:.2f} m' if wavelength >= 1.0 else f'{wavelength * 1e3:.0f} mm'
