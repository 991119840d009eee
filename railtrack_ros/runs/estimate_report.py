"""The report of an estimate: what stands out along the track, and what it was computed with."""

from __future__ import annotations

import math
import multiprocessing
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from railtrack_ros import __version__
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.analysis import Analysis
from railtrack_ros.estimation.limits import load_limits
from railtrack_ros.estimation.section import Judge
from railtrack_ros.estimation.settings import IndicatorSettings, declared
from railtrack_ros.report import style
from railtrack_ros.report.content import Card, Report, Table, Tile
from railtrack_ros.report.page import write_report
from railtrack_ros.runs.estimated import Estimated
from railtrack_ros.runs.indicators import indicators as analysis_of
from railtrack_ros.runs.report_parts import (
    corrugation_cards,
    corrugation_findings,
    described_track,
    indicators_of,
    worst_tile,
)
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle


def write_estimate_report(path: str | Path, name: str, found: Estimated, track: Track,
                          vehicle: Vehicle, indicators: IndicatorSettings,
                          output: str | Path,
                          progress: Callable[[float, float], None] = lambda done, total: None,
                          jobs: int = 1) -> Report:
    """Write the page on an estimate; returns its content.

    Parameters
    ----------
    name
        Of the recording.
    output
        The recording with the estimate, whose rails are analysed here.
    progress
        Called with the seconds of it that are done, and all of them.
    jobs
        Processes that share the rails, 0: one for each core.
    """
    judge = Judge(indicators, found.settings, load_limits(indicators.limits))
    cards: list[Card] = []
    if found.sections:
        tasks = [(output, indicators, vehicle)]
        if jobs != 1:
            tasks = [(output, indicators, replace(vehicle, axle_boxes=vehicle.on_rail(rail)))
                     for rail in vehicle.rails]
        if len(tasks) == 1:
            analysis = _analysis(*tasks[0], progress)
        else:
            with multiprocessing.get_context('spawn').Pool(jobs or None, _begin) as pool:
                analysis = joined(pool.starmap(_analysis, tasks))
        cards = corrugation_cards(analysis, judge, vehicle)
    report = estimate_report(name, found, track, vehicle, judge, cards)
    write_report(path, report)
    return report


def _begin() -> None:
    """Leave interrupts to the process that has begun this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _analysis(output: str | Path, indicators: IndicatorSettings, vehicle: Vehicle,
              progress: Callable[[float, float], None] = lambda done, total: None) -> Analysis:
    """Analyse the rails that the axle boxes of a vehicle run on; nothing where none is valid."""
    try:
        found = analysis_of(output, indicators, vehicle, None, progress, 'zero-phase', True)
    except InputError:  # no valid section
        return Analysis()
    return found.analysis or Analysis()


def joined(parts: Sequence[Analysis]) -> Analysis:
    """Return the analyses of several rails as one."""
    return Analysis(
        combined=[section for part in parts for section in part.combined],
        cleaned=[measured for part in parts for measured in part.cleaned],
        rails=[section for part in parts for section in part.rails],
        wheels=[wheel for part in parts for wheel in part.wheels],
    )


def estimate_report(name: str, found: Estimated, track: Track, vehicle: Vehicle,
                    judge: Judge, cards: Sequence[Card] = ()) -> Report:
    """Compose the page from the sections and the figures of an estimate, and further parts."""
    sections = indicators_of(found.sections, judge)
    forces = [(b.lowest_force, b.highest_force) for b in found.boxes.values() if b.valid]
    valid = sum(b.valid for b in found.boxes.values()) / max(
        1, sum(b.samples for b in found.boxes.values()))
    return Report(
        title=f'Estimate of {name}',
        subtitle=f'{name}, track {track.name}, vehicle {vehicle.name}',
        findings=[*corrugation_findings(sections), *_defects(found)],
        tiles=[
            Tile('run', f'{found.distance:.0f} m',
                 f'{found.start:.0f} m to {found.end:.0f} m in {found.duration:.1f} s'),
            Tile('speed', f'{3.6 * found.highest_speed:.0f} km/h',
                 f'at most; at least {3.6 * found.lowest_speed:.0f} km/h'),
            *worst_tile(sections),
            Tile('contact force', f'{1e-3 * max(f[1] for f in forces):.0f} kN',
                 f'largest; least {1e-3 * min(f[0] for f in forces):.0f} kN'),
            Tile('valid', f'{100.0 * valid:.1f} %', 'of all samples'),
        ],
        indicators=sections,
        tables=[_boxes(found)],
        cards=cards,
        parameters=_parameters(name, found, track, vehicle, judge.settings),
        methods=[
            'Contact force from the acceleration of each axle box, with the static load; rail '
            'deflection from the forces of all wheels on the rail through the modes of the '
            'periodic track; irregularity from wheel displacement, contact indentation and rail '
            'deflection, causally high-passed in wavelength (Butterworth of order 4, cut-on '
            f'{found.settings.cut_on_wavelength:g} m). Forces hold above about 20 Hz.',
            'Sections: the irregularity of each axle box on a grid along its own place, '
            'through causal Butterworth band-passes of order 4 with -3 dB at the ends of each '
            'band; the root mean square of each section.',
        ],
    )


def _defects(found: Estimated) -> list[str]:
    kinds = (('The recording has defects', found.defects), ('In the recording', found.remarks))
    lines = [f'{title}: {"; ".join(told[:4])}' + (' and more.' if len(told) > 4 else '.')
             for title, told in kinds if told]
    return lines if found.defects else ['The recording has no defects.', *lines]


def _boxes(found: Estimated) -> Table:
    rows = []
    for name, box in found.boxes.items():
        sections = [s for s in found.sections if s.axle_box == name]
        worst = max((s.rms[1] for s in sections if math.isfinite(s.rms[1])), default=math.nan)
        named = [s for s in sections if math.isfinite(s.dominant_wavelength)]
        rows.append([
            style.box_title(name), f'{100.0 * box.valid / max(box.samples, 1):.1f}',
            f'{1e-3 * box.lowest_force:.1f}' if box.valid else '',
            f'{1e-3 * box.highest_force:.1f}' if box.valid else '',
            f'{1e6 * worst:.1f}' if math.isfinite(worst) else '', str(len(named)),
            f'{1e3 * float(np.median([s.dominant_wavelength for s in named])):.0f}'
            if named else ''])
    return Table('Axle boxes', (
        'axle box', 'valid [%]', 'least force [kN]', 'largest force [kN]',
        'worst 30-100 mm RMS [µm]', 'sections with a dominant wavelength', 'its median [mm]'), rows)


def _parameters(name: str, found: Estimated, track: Track, vehicle: Vehicle,
                indicators: IndicatorSettings) -> Mapping[str, Mapping[str, str]]:
    def told(settings: object) -> dict[str, str]:
        return {s.name.replace('_', ' '): f'{getattr(settings, s.name)} {s.unit}'.strip()
                for s in declared(type(settings))}

    return {
        'recording': {'file': name, 'sample rate': f'{found.sample_rate:.6g} Hz',
                      'software': f'railtrack_ros {__version__}'},
        **described_track(track, vehicle),
        'estimator': told(found.settings),
        'sections': told(indicators),
    }
