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
from railtrack_ros.report import sections, style
from railtrack_ros.report.content import (
    BandError,
    ErrorPlot,
    Indicators,
    Latency,
    Report,
    Spectrum,
    Table,
    Tile,
    Waveform,
    WaveformPlot,
)
from railtrack_ros.runs import comparison
from railtrack_ros.runs.comparison import Error
from railtrack_ros.runs.replay_model import PAIRS, Replayed
from railtrack_ros.runs.replay_spectra import spectra
from railtrack_ros.track.bay import Mesh
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

UNEXPLAINED = 0.3        # of the measured RMS: a larger difference is not explained
MOST_ROWS = 25           # of a table on the page
VIEW = 8.0               # [m] of waveform on the page at least
POINTS = 5400            # of a curve at most
PER_WAVE = 6.0           # points per shortest wave

# Quantity -> title, name, unit, scale.
PLOTS = {
    'irregularity': ('Irregularity', 'irregularity', 'µm', 1e6),
    'contact_force': ('Contact force', 'contact force', 'kN', 1e-3),
    'rail_deflection': ('Rail deflection', 'rail deflection', 'mm', 1e3),
    'axle_box_acceleration': ('Axle-box acceleration', 'acceleration', 'm/s²', 1.0),
}
NAMES = {'truth': 'true', 'measured': 'measured', 'full_model': 'full model',
         'estimated': 'estimated'}


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
                  levels: Mapping[str, Spectrum] | None = None) -> Report:
    """Compose the report of a replay; without truth, indicators or latency those parts lack.

    levels: spectra of the irregularity over the whole stretch, where `found` shows a window of it.
    """
    window = _window(found, vehicle, indicators)
    plots = {quantity: _waveforms(found, vehicle, quantity, window) for quantity in PLOTS}
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
        errors=[_error_plot(found, q) for q in ('contact_force', 'rail_deflection',
                                                'axle_box_acceleration')],
        tables=[_unexplained_table(found), _table(found, vehicle)],
        latency=latency,
        parameters=about.parameters or {},
        methods=_methods(found),
        highlight=found.compared,
        axle_box=_shown(vehicle, indicators),
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


def corrugation_findings(indicators: Indicators | None) -> list[str]:
    """Say where the irregularity is above its limit."""
    if indicators is None or not indicators.rows or not indicators.limits:
        return []
    found = sections.exceedances(indicators)
    if not found:
        return ['No section is above its limit in any band of wavelength.']
    first = found[0]
    same = [e for e in found if e.band == first.band and e.start < first.end
            and first.start < e.end]
    rails = 'both rails' if len({e.rail for e in same}) > 1 else f'the {first.rail} rail'
    begin, end = min(e.start for e in same), max(e.end for e in same)
    band = style.BAND_NAMES[first.band]
    if first.wavelength is None:
        text = (f'From {begin:.0f} m to {end:.0f} m irregularity of {band} wavelength is above its '
                f'limit on {rails}: up to')
    else:
        verb = 'are' if rails.startswith('both') else 'is'
        text = (f'{rails[0].upper()}{rails[1:]} {verb} corrugated from {begin:.0f} m to '
                f'{end:.0f} m, with a wavelength of {first.wavelength * 1e3:.0f} mm: irregularity '
                f'of {band} wavelength reaches')
    text += (f' {first.worst:.1f} µm RMS in a section, {first.worst / first.limit:.1f} times the '
             'limit.')
    others = [e for e in found if e not in same]
    if others:
        text += (f' {len(others)} more stretch{"es are" if len(others) > 1 else " is"} above a '
                 f'limit, by a factor of {others[0].worst / others[0].limit:.1f} at most.')
    return [text]


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
    force = worst(found.errors, 'contact_force', 'estimated', 'truth')
    if force is not None:
        difference, reference = _overall(found, 'contact_force', 'estimated', 'truth')
        texts.append(
            f'The estimated contact force misses the true one by {difference / 1e3:.2f} kN RMS, '
            f'{100 * difference / reference:.1f} % of its dynamic part; the largest error in a '
            f'one-third octave is {abs(force.level_difference):.2f} dB, at {force.frequency:.0f} '
            'Hz.')
    shape = worst(found.errors, 'irregularity', 'estimated', 'truth')
    if shape is not None:
        lines = [e for e in found.errors if e.quantity == 'irregularity' and e.band == 'frequency']
        texts.append(
            f'The true irregularity comes back within {abs(shape.level_difference):.2f} dB in '
            f'every one-third octave from {_millimetres(max(e.wavelength for e in lines))} down '
            f'to {_millimetres(min(e.wavelength for e in lines))} of wavelength.')
    return texts


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
        error = worst(found.errors, quantity, *pair)
        if error is not None:
            tiles.append(Tile(label, f'{abs(error.level_difference):.2f} dB',
                              f'worst one-third octave, {who}'))
    if latency is not None:
        tiles.append(Tile('live latency', f'{1e3 * float(np.median(latency.delay)):.1f} ms',
                          f'median; 99 % within '
                          f'{1e3 * float(np.percentile(latency.delay, 99)):.1f} ms'))
    return tiles


def worst_tile(indicators: Indicators | None) -> list[Tile]:
    """Return the key figure of the stretch that is furthest above its limit."""
    if indicators is None or not indicators.limits:
        return []
    above = sections.exceedances(indicators)
    if not above:
        return [Tile('above a limit', 'nothing', 'in any band of wavelength')]
    return [Tile('worst stretch', f'{above[0].worst / above[0].limit:.1f} × limit',
                 f'{above[0].start:.0f} to {above[0].end:.0f} m, {above[0].rail} rail, '
                 f'{style.BAND_NAMES[above[0].band]}')]


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


def described_track(track: Track, vehicle: Vehicle) -> dict[str, dict[str, str]]:
    """Return the figures of track and vehicle, in groups."""
    rail, support, wheel = track.rail, track.support, vehicle.wheel
    return {
        f'track {track.name}': {
            'support': f'{support.kind}, every {support.spacing:g} m',
            'rail pad': f'{support.pad_stiffness / 1e6:g} MN/m, {support.pad_damping / 1e3:g} '
                        f'kNs/m, {support.pad_length * 1e3:g} mm long',
            'sleeper mass per rail': f'{support.sleeper_mass:g} kg',
            'ballast': f'{support.ballast_stiffness / 1e6:g} MN/m, '
                       f'{support.ballast_damping / 1e3:g} kNs/m',
            'rail': f'EI {rail.bending_stiffness / 1e6:.4g} MNm², '
                    f'{rail.mass_per_length:.4g} kg/m, loss factor {rail.loss_factor:g}',
        },
        f'vehicle {vehicle.name}': {
            'axle boxes': str(len(vehicle.axle_boxes)),
            'wheel': f'{wheel.mass:g} kg unsprung, {wheel.static_load / 1e3:g} kN static load',
            'contact': f'{vehicle.contact.stiffness:g} N/m^{vehicle.contact.exponent:g}',
        },
    }


# Plots


def _shown(vehicle: Vehicle, indicators: Indicators | None) -> str:
    """Return the axle box to begin with: one on the rail where there is most to see."""
    above = sections.exceedances(indicators) if indicators is not None else []
    rail = above[0].rail if above else vehicle.rails[0]
    return (vehicle.on_rail(rail) or vehicle.axle_boxes)[0].name


def _window(found: Replayed, vehicle: Vehicle, indicators: Indicators | None
            ) -> tuple[float, float]:
    """Track positions [m] between which waveforms are shown: where something begins, or the middle.

    Every axle box passes the same piece of track, each at its own time.
    """
    spans = []
    for box in vehicle.axle_boxes:
        values = found.full_model['contact_force'][box.name]
        good = found.stretch.start + np.flatnonzero(np.isfinite(values[found.stretch]))
        if good.size:
            places = found.samples.position[good] + box.offset
            spans.append((float(places.min()), float(places.max())))
    first, last = max(s[0] for s in spans), min(s[1] for s in spans)
    if last - first < 1.0:        # a short stretch under a long vehicle
        first, last = spans[0]
    speed = float(np.abs(found.samples.speed[found.stretch]).mean())
    length = min(max(VIEW, _grid_step(found, speed) * 1000), last - first)
    centre = (first + last) / 2
    if indicators is not None and indicators.limits:
        ends = [x for e in sections.exceedances(indicators)[:2] for x in (e.start, e.end)]
        inside = [x for x in ends if first + 1.0 < x < last - 1.0]
        centre = inside[0] if inside else centre
    begin = min(max(centre - length / 2, first), last - length)
    return begin, begin + length


def _grid_step(found: Replayed, speed: float) -> float:
    return speed * max(found.samples.time_step, 1.0 / (PER_WAVE * found.band.high))


def _waveforms(found: Replayed, vehicle: Vehicle, quantity: str, window: tuple[float, float]
               ) -> WaveformPlot:
    """Resample all descriptions of a quantity on a uniform grid along the track."""
    title, name, unit, scale = PLOTS[quantity]
    signals = found.signals(quantity)
    boxes: dict[str, Waveform] = {}
    for box in vehicle.axle_boxes:
        place = found.samples.position[found.stretch] + box.offset
        forward = 1.0 if place[-1] >= place[0] else -1.0
        order = slice(None) if forward > 0 else slice(None, None, -1)
        near = np.flatnonzero((place >= window[0] - 1.0) & (place <= window[1] + 1.0))
        if near.size < 2:
            continue
        part = slice(int(near[0]), int(near[-1]) + 1)
        speed = float(np.abs(found.samples.speed[found.stretch][part]).mean())
        step = max(_grid_step(found, speed), (window[1] - window[0]) / POINTS)
        grid = np.arange(window[0], window[1], step)
        curves = {}
        for who, channels in signals.items():
            if box.name in channels:
                values = found.band.low_pass(channels[box.name])[found.stretch][part]
                curves[who] = np.interp(grid, place[part][order], values[order], np.nan, np.nan)
        if curves:
            boxes[box.name] = Waveform(float(window[0]), float(step), curves)
    remark = {
        'irregularity': 'Combined irregularity of wheel and rail, causally high-passed in '
                        'wavelength as it is published live'
                        + ('; the true one has passed the same filter.'
                           if found.truth_irregularity else '.'),
        'contact_force': 'Compressive force, static load included. Drag to zoom, double-click to '
                         'go back; the slider below moves along the piece of track.',
        'rail_deflection': 'At the contact, up positive: the whole deflection, static part and all '
                           'wheels on that rail.',
        'axle_box_acceleration': 'What the model does not explain is what the curves leave '
                                 'between them.',
    }[quantity]
    return WaveformPlot(title, name, unit, scale, boxes, remark)


def _error_plot(found: Replayed, quantity: str) -> ErrorPlot:
    pairs: dict[str, dict[str, BandError]] = {}
    for compared, reference in PAIRS[quantity]:
        boxes: dict[str, list[Error]] = {}
        for e in found.errors:
            if (e.quantity, e.compared, e.reference, e.band) == (
                    quantity, compared, reference, 'frequency'):
                boxes.setdefault(e.axle_box, []).append(e)
        if boxes:
            pairs[f'{NAMES[compared]} - {NAMES[reference]}'] = {
                name: BandError(np.array([e.frequency for e in lines]),
                                np.array([e.wavelength for e in lines]),
                                np.array([e.level_difference for e in lines]),
                                np.array([e.coherence for e in lines]))
                for name, lines in boxes.items()}
    return ErrorPlot(f'{PLOTS[quantity][0]}: level differences in one-third octaves', pairs,
                     'Line: the chosen axle box, shade: the range of all. Coherence: 1 where one '
                     'is the other through a linear filter, near 0 where they are strangers.')


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
