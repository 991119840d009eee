"""What a comparison of two results found, in words, tables and plots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from railtrack_ros.irregularity.spectra import REFERENCE, iso3095_limit
from railtrack_ros.output import write_csv
from railtrack_ros.report import style
from railtrack_ros.report.content import (
    BandError,
    ErrorPlot,
    Report,
    Spectrum,
    Table,
    Tile,
    Waveform,
    WaveformPlot,
)
from railtrack_ros.report.page import write_report
from railtrack_ros.runs.compare import (
    FIRST,
    LEAST_CORRELATION,
    SECOND,
    STEP,
    WINDOW,
    Compared,
    name_of,
    shifted_by,
)
from railtrack_ros.runs.comparison import Error
from railtrack_ros.runs.replay_files import complete_folder, write_errors
from railtrack_ros.runs.replay_plots import PLOTS
from railtrack_ros.runs.replay_report import MOST_ROWS, overall

SHOWN = 8.0      # m of waveform on the page
EVERY = 2        # samples of the grid of which one is drawn


def write_comparison(folder: Path, found: Compared) -> Report:
    """Write ``report.html``, ``errors.csv`` and ``shifts.csv``; returns the report."""
    report = comparison_report(found)
    with complete_folder(folder) as place:
        write_errors(place / 'errors.csv', found.errors)
        write_csv(place / 'shifts.csv', {
            'from_m': [s.begin for s in found.shifts],
            'to_m': [s.end for s in found.shifts],
            'shift_m': [round(s.shift, 5) for s in found.shifts],
            'correlation': [round(s.correlation, 5) for s in found.shifts],
        })
        write_report(place / 'report.html', report)
    return report


def summary(found: Compared) -> dict[str, Any]:
    """Return the figures under machine-readable names."""
    begin, end = found.extent
    differences = []
    for quantity in found.quantities:
        total = overall(found.errors, quantity, SECOND, FIRST)
        if total is not None:
            worst = max((e for e in found.errors if e.quantity == quantity
                         and e.band == 'wavelength'),
                        key=lambda e: abs(e.level_difference), default=None)
            differences.append({
                'quantity': quantity, 'rms_difference': total[0], 'rms_first': total[1],
                'worst_third_octave_db': worst and worst.level_difference,
                'worst_third_octave_m': worst and worst.wavelength,
                'worst_axle_box': worst and worst.axle_box,
            })
    return {
        'first': name_of(found.first), 'second': name_of(found.second),
        'from_m': begin, 'to_m': end, 'axle_boxes': found.axle_boxes,
        'shift_m': shifted_by(found), 'differences': differences,
        'files': ['report.html', 'errors.csv', 'shifts.csv'],
    }


def comparison_report(found: Compared) -> Report:
    """Compose the report."""
    begin, end = found.extent
    plots = [_waveforms(found, quantity) for quantity in found.quantities]
    irregularity = [p for p in plots if p.quantity == 'irregularity']
    return Report(
        title='Two results over the same track',
        subtitle=f'first: {name_of(found.first)}; second: {name_of(found.second)}',
        findings=_findings(found),
        tiles=[Tile('compared', f'{end - begin:.0f} m', f'from {begin:.0f} m to {end:.0f} m'),
               *_tiles(found)],
        irregularity=irregularity[0] if irregularity else None,
        spectra=_spectra(found),
        spectrum_remark='One-third-octave levels over all that is compared, in the wavelengths '
                        'that both resolve. The limit is that of ISO 3095 for rails of test '
                        'tracks, for orientation.',
        waveforms=[*(_along(found, q) for q in found.quantities),
                   *(p for p in plots if p.quantity != 'irregularity')],
        errors=[_error_plot(found, q) for q in found.quantities],
        tables=[_sections(found), _shifts(found)],
        parameters={'compared': {
            'first': name_of(found.first), 'second': name_of(found.second),
            'axle boxes': ', '.join(found.axle_boxes),
            'wavelengths': f'{1e3 / found.band.high:.3g} mm to {1.0 / found.band.low:.3g} m',
            'windows': f'{WINDOW:g} m, aligned one by one', 'grid': f'{1e3 * STEP:g} mm',
        }},
        methods=[
            'Both results are put on a grid along the track by splines, each axle box at its own '
            'place. The second is shifted, window by window, to the peak of the '
            'cross-correlation of the irregularity of all axle boxes; a window with a correlation '
            f'below {LEAST_CORRELATION:g} keeps the shift of the one before.',
            'Differences are taken within the wavelengths that both resolve: Butterworth '
            f'high-pass of order 4 at {1.0 / found.band.low:.3g} m and low-pass of order 8 at '
            f'{1e3 / found.band.high:.3g} mm, both forwards and backwards (zero phase).',
        ],
    )


def _findings(found: Compared) -> list[str]:
    texts = []
    for quantity in found.quantities:
        total = overall(found.errors, quantity, SECOND, FIRST)
        if total is None:
            continue
        _, name, unit, scale = PLOTS[quantity]
        levels = [abs(e.level_difference) for e in _lines(found, quantity, 'wavelength')]
        worst = f'; no one-third octave differs by more than {max(levels):.2f} dB' if levels else ''
        texts.append(f'{name[0].upper()}{name[1:]}: the second differs from the first by '
                     f'{scale * total[0]:.3g} {unit} RMS, {100.0 * total[0] / total[1]:.1f} % of '
                     f'it{worst}.')
    shift = shifted_by(found)
    if shift:
        texts.append(f'The positions of the second are {shift["median"]:+.3f} m off those of the '
                     f'first in the median, {shift["lowest"]:+.3f} m to {shift["highest"]:+.3f} m '
                     'along the track.')
    unsure = sum(s.correlation < LEAST_CORRELATION for s in found.shifts)
    if unsure:
        texts.append(f'In {unsure} of {len(found.shifts)} windows the two do not look like the '
                     'same rail; they are compared at the shift of the window before.')
    return texts


def _tiles(found: Compared) -> list[Tile]:
    tiles = []
    for quantity in found.quantities:
        total = overall(found.errors, quantity, SECOND, FIRST)
        if total is not None:
            _, name, unit, scale = PLOTS[quantity]
            tiles.append(Tile(name, f'{scale * total[0]:.3g} {unit}',
                              f'RMS difference, {100.0 * total[0] / total[1]:.1f} % of the first'))
    shift = shifted_by(found)
    return [*tiles, *([Tile('shift', f'{shift["median"]:+.2f} m', 'of the second, median')]
                      if shift else [])]


def _lines(found: Compared, quantity: str, band: str) -> list[Error]:
    return [e for e in found.errors if (e.quantity, e.band) == (quantity, band)]


def _waveforms(found: Compared, quantity: str) -> WaveformPlot:
    """Show both where they differ most."""
    title, name, unit, scale = PLOTS[quantity]
    boxes = {}
    for box, (start, first, second) in found.shown.get(quantity, {}).items():
        middle, half = first.size // 2, round(0.5 * SHOWN / STEP)
        part = slice(max(0, middle - half), middle + half, EVERY)
        boxes[box] = Waveform(start + part.start * STEP, EVERY * STEP,
                              {FIRST: first[part], SECOND: second[part]})
    return WaveformPlot(title, name, unit, scale, boxes,
                        'In the window where the two differ most, at the place of the first.')


def _along(found: Compared, quantity: str) -> WaveformPlot:
    """Show the RMS of both per section along the track."""
    title, name, unit, scale = PLOTS[quantity]
    boxes = {}
    for box in found.axle_boxes:
        lines = {e.begin: e for e in _lines(found, quantity, 'section') if e.axle_box == box}
        if not lines:
            continue
        step = next(iter(lines.values())).end - next(iter(lines.values())).begin
        grid = np.arange(min(lines), max(lines) + 0.5 * step, step)
        near = [lines.get(float(x)) for x in grid]
        boxes[box] = Waveform(float(grid[0] + 0.5 * step), float(step), {
            FIRST: np.array([np.nan if e is None else e.rms_reference for e in near]),
            SECOND: np.array([np.nan if e is None else e.rms_compared for e in near])})
    return WaveformPlot(f'{title} per section', f'RMS of {name}', unit, scale, boxes,
                        'Root mean square within the compared wavelengths, section by section.')


def _spectra(found: Compared) -> dict[str, Spectrum]:
    result = {}
    for box in found.axle_boxes:
        lines = sorted((e for e in _lines(found, 'irregularity', 'wavelength')
                        if e.axle_box == box), key=lambda e: -e.wavelength)
        if lines:
            wavelength = np.array([e.wavelength for e in lines])
            result[box] = Spectrum(wavelength, {
                'limit': iso3095_limit(wavelength),
                FIRST: 20.0 * np.log10([e.rms_reference / REFERENCE for e in lines]),
                SECOND: 20.0 * np.log10([e.rms_compared / REFERENCE for e in lines])})
    return result


def _error_plot(found: Compared, quantity: str) -> ErrorPlot:
    boxes = {}
    for box in found.axle_boxes:
        lines = [e for e in _lines(found, quantity, 'wavelength') if e.axle_box == box]
        if lines:
            boxes[box] = BandError(
                np.full(len(lines), np.nan), np.array([e.wavelength for e in lines]),
                np.array([e.level_difference for e in lines]),
                np.array([e.coherence for e in lines]))
    return ErrorPlot(f'{PLOTS[quantity][0]}: level of the second minus level of the first',
                     {'second - first': boxes} if boxes else {},
                     'Line: the chosen axle box, shade: the range of all. Coherence: 1 where one '
                     'is the other through a linear filter, near 0 where they are strangers.',
                     over='wavelength')


def _sections(found: Compared) -> Table:
    """List the sections in which the irregularity differs most."""
    quantity = found.quantities[-1]
    _, name, unit, scale = PLOTS[quantity]
    lines = sorted(_lines(found, quantity, 'section'), key=lambda e: -abs(e.level_difference))
    return Table(
        f'Sections in which the {name} differs most',
        ('axle box', 'from - to [m]', f'first [{unit}]', f'second [{unit}]', 'level [dB]',
         f'difference [{unit}]'),
        [[style.box_title(e.axle_box), f'{e.begin:.0f} - {e.end:.0f}',
          f'{scale * e.rms_reference:.3g}', f'{scale * e.rms_compared:.3g}',
          f'{e.level_difference:+.2f}', f'{scale * e.rms_difference:.3g}']
         for e in lines[:MOST_ROWS]],
        f'Of {len(lines)}; errors.csv holds all of them.')


def _shifts(found: Compared) -> Table:
    step = max(1, len(found.shifts) // MOST_ROWS + 1)
    rows: Sequence[Sequence[str]] = [
        [f'{s.begin:.0f} - {s.end:.0f}', f'{s.shift:+.3f}', f'{s.correlation:.3f}']
        for s in found.shifts[::step]]
    return Table('Shift of the second along the track',
                 ('from - to [m]', 'shift [m]', 'correlation'), rows,
                 f'Every {step}th window; shifts.csv holds all of them.' if step > 1 else '')
