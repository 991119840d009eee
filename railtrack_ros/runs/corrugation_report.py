"""The report on the corrugation of the rails, from what an analysis has found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from railtrack_ros import __version__
from railtrack_ros.errors import InputError
from railtrack_ros.estimation import roughness
from railtrack_ros.estimation.analysis import Analysis
from railtrack_ros.estimation.bands import band_title
from railtrack_ros.estimation.rails import RailSection, Stretch, describe, length_of
from railtrack_ros.estimation.wheels import pooled
from railtrack_ros.output import metres
from railtrack_ros.report.content import Card, Report, Table, Tile
from railtrack_ros.report.corrugation import CorrugationData, RailData, card, wheel_orders
from railtrack_ros.report.corrugation_sheet import draw_sheet
from railtrack_ros.report.page import write_report
from railtrack_ros.runs.indicators import Indicated
from railtrack_ros.runs.rail_rows import Row, Setting

TABLE_ROWS = 40


def corrugation_data(found: Analysis, setting: Setting) -> CorrugationData:
    """Return an analysis as the plots want it.

    Raises
    ------
    InputError
        There is no section to plot.
    """
    if not found.rails:
        raise InputError('there is no section with valid irregularity to plot')
    judge = setting.judge
    limits = [judge.limits.of(band) for band in judge.bands]
    return CorrugationData(
        [band_title(band) for band in judge.bands],
        np.array([math.nan if limit is None else 1e6 * limit.limit for limit in limits]),
        judge.limits.title, judge.limits.statistic == 'moving_rms',
        roughness.CENTRES,
        {name: _rail([s for s in found.rails if s.rail == name], setting)
         for name in dict.fromkeys(section.rail for section in found.rails)},
        setting.contact_filter)  # fmt: skip


def write_corrugation_plot(path: str | Path, found: Indicated, setting: Setting) -> None:
    """Draw strip chart and spectrogram as .png, .svg or .pdf."""
    assert found.analysis is not None
    draw_sheet(path, corrugation_data(found.analysis, setting))


def write_report_of(path: str | Path, recording: str, found: Indicated, setting: Setting,
                    stretches: Sequence[Stretch], grind: Sequence[Row]) -> None:
    """Write the page with all plots, the grind list, the wheels, and what it was computed with."""
    assert found.analysis is not None
    data = corrugation_data(found.analysis, setting)
    sections = found.analysis.rails
    total = sum(s.end - s.start for s in sections)
    bad = length_of(stretches)
    excluded = sum(s.excluded for s in sections)
    share = 100.0 * bad / max(total, 1e-9)
    findings = [f'{bad:g} m of {total:g} m of rail are in stretches above the limits of '
                f'{setting.judge.limits.title} ({share:.0f} %).',
                *(f'{describe(stretch)[0].upper()}{describe(stretch)[1:]}.'
                  for stretch in stretches[:3])]
    if excluded:
        findings.append(f'{excluded} of {len(sections)} sections were struck by impacts, as over '
                        'joints and switches, and are left out of averages.')
    doubts: dict[tuple[str, str], list[str]] = {}
    for item in setting.judge.limits.bands:
        if item.band in setting.judge.bands:
            for doubt in item.uncertain.items():
                doubts.setdefault(doubt, []).append(band_title(item.band))
    tiles = [
        Tile('to grind', f'{share:.0f} %', f'{bad:g} m of {total:g} m of rail'),
        Tile('stretches', str(len(stretches)), f'closer than {setting.merge:g} m are one'),
    ]
    if stretches:
        worst = stretches[0]
        tiles.append(Tile('worst', f'{worst.ratio:.1f} × limit',
                          f'{worst.rail} rail, {metres(worst.start)} to {metres(worst.end)} m'))
    report = Report(
        title='Corrugation', subtitle=Path(recording).name, findings=findings, tiles=tiles,
        cards=[card(data), Card('What to do', tables=[_grind_table(grind)]),
               *_wheel_cards(found.analysis)],
        parameters={
            'sections': {key: str(value) for key, value in asdict(found.judge.settings).items()},
            'limits': {'title': setting.judge.limits.title, 'source': setting.judge.limits.source,
                       'statistic': setting.judge.limits.statistic,
                       'uncertain': '; '.join(
                           f'{key} ({", ".join(bands)}): {reason}'
                           for (key, reason), bands in doubts.items()) or 'nothing'},
            'traffic and contact': {
                'speeds': 'as told' if setting.line_speed else 'that of the measurement',
                'contact filter': setting.contact_filter,
                'wheel': f'{1e-3 * setting.load:g} kN, radius {setting.radius:g} m'},
            'software': {'railtrack_ros': __version__},
        },
        methods=[
            'Bands are Butterworth band-passes of order 4 in wavenumber, -3 dB at their ends, '
            "applied without delay. What repeats with a wheel's circumference is estimated and "
            'taken off over reaches of 400 m; the axle boxes of a rail are then fused by the '
            'median of their mean squares (the mean of two).',
            'All levels are those of the combined irregularity of wheel and rail, measured '
            'indirectly. Where the contact filter is taken off, nothing below 20 mm is called '
            'roughness of the rail.',
        ])  # fmt: skip
    write_report(path, report)


def _rail(sections: list[RailSection], setting: Setting) -> RailData:
    sections.sort(key=lambda section: section.start)
    levels = [setting.levels(section) for section in sections]
    return RailData(
        np.array([s.start for s in sections]), np.array([s.end for s in sections]),
        np.array([s.excluded for s in sections]), 1e6 * np.array([s.rms for s in sections]),
        np.array([s.spread for s in sections]), 100.0 * np.array([s.above for s in sections]),
        np.array([combined for combined, _ in levels]), np.array([rail for _, rail in levels]))


def _grind_table(grind: Sequence[Row]) -> Table:
    def text(value: object, digits: int = 1, scale: float = 1.0) -> str:
        return ('' if not isinstance(value, (int, float))
                else f'{round(scale * value, digits) + 0.0:.{digits}f}')

    rows = [[
        str(row['rank']), str(row['rail']), f'{text(row["from_m"], 0)} - {text(row["to_m"], 0)}',
        text(row['length_m'], 0), str(row['level']), str(row['band_mm']), text(row['worst_um']),
        text(row['limit_um']), text(row['times_limit']),
        text(row['dominant_wavelength_m'], 0, 1e3), text(row['dominant_depth_um'], 0),
        str(row['mechanism'] or ('none known' if row['mechanism_certainty'] else '')),
        str(row['mechanism_certainty']), text(row['noise_index_db']),
        text(row['spread_db']),
    ] for row in grind[:TABLE_ROWS]]  # fmt: skip
    columns = ('rank', 'rail', 'from - to [m]', 'length [m]', 'level', 'band [mm]', 'worst [µm]',
               'limit [µm]', 'ratio', 'wavelength [mm]', 'depth [µm]', 'mechanism', 'certainty',
               'noise index [dB]', 'spread [dB]')  # fmt: skip
    return Table('Stretches to grind' if rows else 'No stretch is above a limit',
                 columns if rows else (), rows,
                 'The worst section speaks for each; ranked by its ratio to the limit and the '
                 'length. Empty: wavelength, depth and mechanism where nothing stands out in the '
                 'band, noise index where speed and sample rate resolve too little of it, spread '
                 'where a single axle box ran.' + (f' The first {TABLE_ROWS} of {len(grind)}.'
                              if len(grind) > TABLE_ROWS else ''))


def _wheel_cards(found: Analysis) -> list[Card]:
    wheels = [wheel for wheel in pooled(found.wheels) if not math.isnan(wheel.radius)]
    if not wheels:
        return []
    rows = []
    for wheel in wheels:
        worst = np.argsort(-wheel.amplitude)[:3]
        rows.append([
            wheel.axle_box,
            f'{min(wheel.start, wheel.end):.0f} - {max(wheel.start, wheel.end):.0f}',
            f'{1e3 * wheel.radius:.2f}', f'{wheel.revolutions:.0f}',
            ', '.join(f'order {n + 1}: {1e6 * wheel.amplitude[n]:.1f}' for n in worst)])
    plot = wheel_orders({wheel.axle_box: (1e6 * wheel.amplitude, 1e6 * wheel.uncertainty)
                         for wheel in wheels})
    return [Card('Wheels out of round', [
        ('By order', 'Amplitude of each order, that is of the waves around the wheel, with its '
         'standard deviation: what the rail has in the same line cannot be told from it.', plot),
    ], tables=[Table('Largest orders', (
        'axle box', 'from - to [m]', 'radius [mm]', 'revolutions', 'largest amplitudes [µm]'),
        rows, 'Estimated from what repeats with the circumference, and taken off the rails.')])]
