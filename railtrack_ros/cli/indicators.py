"""Command `railtrack indicators`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.cli.settings_options import add_settings, settings_from
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.limits import shipped_limits
from railtrack_ros.estimation.settings import IndicatorSettings
from railtrack_ros.parameters import NOT_NEGATIVE
from railtrack_ros.track.description import Track, load_track
from railtrack_ros.vehicle.description import load_vehicle

if TYPE_CHECKING:
    from railtrack_ros.estimation.rails import Stretch
    from railtrack_ros.runs.indicator_tables import Geography
    from railtrack_ros.runs.indicators import Indicated
    from railtrack_ros.runs.rail_rows import Setting

EXAMPLE = (
    'railtrack indicators estimate.mcap --section 10 --output indicators.csv\n'
    '      --grind-list grind.csv --report corrugation.html'
)

# Outputs of the analysis beside the table of sections.
TABLES = ('rails', 'spectra', 'wheels', 'grind_list')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('bag', metavar='BAG', help='a recording with an estimate')
    common.add_output(parser, 'FILE.csv', 'table with a row per section and axle box')
    common.add_vehicle(parser, required=False)
    parser.add_argument(
        '--track', metavar='T', help='for the mechanism (default: as the recording tells)')
    parser.add_argument(
        '--topic', metavar='TOPIC', help='irregularity (default: /track_estimator/irregularity)')
    parser.add_argument(
        '--filters', choices=('causal', 'zero-phase'), default='causal',
        help='of the table of sections: causal, the numbers of the live node, or without delay '
        '(default: causal; everything below is zero-phase)')  # fmt: skip
    more = parser.add_argument_group(
        'analysis of the rails, wheels set apart and axle boxes fused (.csv, .parquet; '
        '.geojson where positions are known on Earth)')  # fmt: skip
    more.add_argument('--rails', metavar='FILE',
                      help='sections and blocks of 50, 100 and 200 m of each rail')
    more.add_argument('--grind-list', metavar='FILE', help='stretches above a limit, ranked')
    more.add_argument('--spectra', metavar='FILE',
                      help='one-third-octave levels of each section against ISO 3095')
    more.add_argument('--wheels', metavar='FILE', help='out-of-roundness of the wheels by order')
    more.add_argument('--waveforms', metavar='FILE',
                      help='irregularity of each rail in each band along the track: .csv, .parquet')
    more.add_argument('--report', metavar='FILE.html', help='plots and tables on one page')
    more.add_argument('--plot', metavar='FILE',
                      help='strip chart and spectrogram: .png, .svg or .pdf')
    more.add_argument(
        '--line-speed', metavar='V|LO:HI|CSV',
        help='speeds of the traffic in m/s, everywhere or by from_m, to_m, speed_m_s: for '
        'mechanism and noise index (default: that of the measurement)')  # fmt: skip
    more.add_argument(
        '--contact-filter', choices=('cnossos', 'remington', 'none'), default='cnossos',
        help='taken off the levels of the rail (default: cnossos)')  # fmt: skip
    more.add_argument('--merge', type=common.number(NOT_NEGATIVE), default=20.0, metavar='M',
                      help='stretches to grind that are closer are one (default: 20 m)')
    more.add_argument('--geography', metavar='CSV',
                      help='position_m, longitude_deg, latitude_deg (default: satellite fixes of '
                      'the recording)')  # fmt: skip
    add_settings(
        parser, IndicatorSettings, f'sections (limits shipped: {", ".join(shipped_limits())})',
        names={'section_length': 'section'})  # fmt: skip


def run(args: argparse.Namespace) -> Outcome:
    """Write the table and tell what stands out."""
    from railtrack_ros.runs.indicator_tables import check_format, read_geography
    from railtrack_ros.runs.indicators import indicators, write_sections
    from railtrack_ros.runs.rail_rows import read_line_speed
    from railtrack_ros.runs.results import describe

    asked = [name for name in TABLES if getattr(args, name)]
    for name in asked:
        check_format(getattr(args, name))
    for path, what in ((args.output, 'the table of sections'), (args.waveforms, 'a waveform')):
        if path:
            check_format(path)
        if str(path).lower().endswith('.geojson'):
            raise InputError(f'{path}: {what} is written as .csv or .parquet')
    geography = read_geography(args.geography) if args.geography else None
    line_speed = read_line_speed(args.line_speed) if args.line_speed else None
    if args.plot:
        from railtrack_ros.report.curves import check_format as check_plot

        check_plot(args.plot)
    vehicle = load_vehicle(args.vehicle) if args.vehicle else None
    track = load_track(args.track) if args.track else None
    settings = settings_from(args, IndicatorSettings)
    with common.progress(None, 's', 'reading') as bar:

        def show(done: float, total: float) -> None:
            bar.total = total
            bar.update(done - bar.n)

        found = indicators(
            args.bag, settings, vehicle, args.topic, show, args.filters,
            bool(asked or args.report or args.plot or args.waveforms), args.waveforms)
    write_sections(args.output, found.sections)
    written = [args.output, *([args.waveforms] if args.waveforms else [])]
    named = [s for s in found.sections if math.isfinite(s.dominant_wavelength)]
    sagging = [s for s in named if _is_spacing(s.dominant_wavelength, track, found.content)]
    named.sort(key=lambda section: (section in sagging, -section.dominant_above_limit))
    lines = [
        f'{len(found.sections)} sections of {settings.section_length:g} m, a wavelength stands '
        f'out in {len(named)}'
        + (f', that of the sleepers in {len(sagging)} of them' if sagging else ''),
        *(f'  {section.axle_box}, {describe(section)}' for section in named[:5]),
    ]
    summary: dict[str, Any] = {
        'output': args.output,
        'sections': len(found.sections),
        'sections_with_dominant_wavelength': len(named),
        'sections_with_that_of_the_sleepers': len(sagging),
        'most_prominent': [section.row() for section in named[:5]],
    }
    if found.analysis is not None:
        from railtrack_ros.runs.rail_rows import (
            Setting,
            described_track,
            described_wheels,
            track_frequencies,
        )

        track = track or described_track(found.content)
        wheels = vehicle or described_wheels(found.content)
        setting = Setting(
            found.judge, track_frequencies(track, wheels) if track and wheels else None,
            line_speed, args.contact_filter, merge=args.merge,
            **({'load': wheels.wheel.static_load, 'radius': wheels.wheel.radius} if wheels
               else {}))  # fmt: skip
        more = _analysed(args, found, setting, geography or found.geography)
        lines += more.pop('lines')
        written += more['written']
        summary.update(more)
    return Outcome(summary, [*lines, f'written: {", ".join(written)}'], found.defects)


def _is_spacing(wavelength: float, track: Track | None, content: Mapping[str, Any]) -> bool:
    """Tell whether a wavelength [m] is the sleeper spacing, of a track or as a recording tells."""
    from railtrack_ros.estimation.mechanism import SPACING_MARGIN

    try:
        spacing = track.support.spacing if track else float(content['track']['support']['spacing'])
    except (KeyError, TypeError, ValueError):
        return False
    return abs(wavelength / spacing - 1.0) <= SPACING_MARGIN


def _analysed(args: argparse.Namespace, found: Indicated, setting: Setting,
              geography: Geography | None) -> dict[str, Any]:
    """Write the tables of the rails and the report, and tell what to grind."""
    from railtrack_ros.estimation import rails
    from railtrack_ros.runs import rail_rows
    from railtrack_ros.runs.indicator_tables import write_table

    analysis = found.analysis
    assert analysis is not None
    stretches = rails.stretches(analysis.rails, found.judge, setting.merge)
    grind = rail_rows.grind_rows(stretches, setting, geography)
    written = []
    for path, make, columns in (
        (args.rails, lambda: rail_rows.rail_rows(analysis, setting), ()),
        (args.spectra, lambda: rail_rows.spectrum_rows(analysis, setting),
         rail_rows.SPECTRUM_COLUMNS),
        (args.wheels, lambda: rail_rows.wheel_rows(analysis), rail_rows.WHEEL_COLUMNS),
        (args.grind_list, lambda: grind, rail_rows.GRIND_COLUMNS),
    ):  # fmt: skip
        if path:
            write_table(path, make(), geography, columns)
            written.append(path)
    if args.report or args.plot:
        from railtrack_ros.runs.corrugation_report import write_corrugation_plot, write_report_of

        if args.report:
            write_report_of(args.report, args.bag, found, setting, stretches, grind)
            written.append(args.report)
        if args.plot:
            write_corrugation_plot(args.plot, found, setting)
            written.append(args.plot)
    return {
        'written': written,
        'lines': _grind_lines(stretches, analysis.rails),
        'length_measured_m': _length(analysis.rails),
        'length_to_grind_m': rails.length_of(stretches),
        'grind_list': grind,
    }


def _grind_lines(stretches: list[Stretch], sections: Any) -> list[str]:
    from railtrack_ros.estimation.rails import describe, length_of

    total, bad = _length(sections), length_of(stretches)
    excluded = sum(section.excluded for section in sections)
    lines = [f'to grind: {bad:g} m of {total:g} m of rail ({100.0 * bad / max(total, 1e-9):.0f} %)'
             + (f', {excluded} sections excluded for impacts' if excluded else '')]
    return [*lines, *(f'  {describe(stretch)}' for stretch in stretches[:5])]


def _length(sections: Any) -> float:
    return float(sum(section.end - section.start for section in sections))
