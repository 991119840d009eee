"""The curves of a replay as the report shows them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.report import sections
from railtrack_ros.report.content import BandError, ErrorPlot, Indicators, Waveform, WaveformPlot
from railtrack_ros.runs.comparison import Error
from railtrack_ros.runs.replay_model import PAIRS, Replayed
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

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


def shown(vehicle: Vehicle, indicators: Indicators | None) -> str:
    """Return the axle box to begin with: one on the rail where there is most to see."""
    above = sections.exceedances(indicators) if indicators is not None else []
    rail = above[0].rail if above else vehicle.rails[0]
    return (vehicle.on_rail(rail) or vehicle.axle_boxes)[0].name


def window(found: Replayed, vehicle: Vehicle, indicators: Indicators | None
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


def waveforms(found: Replayed, vehicle: Vehicle, quantity: str, window: tuple[float, float]
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


def error_plot(found: Replayed, quantity: str) -> ErrorPlot:
    """Return level differences and coherence of all pairs of a quantity."""
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
