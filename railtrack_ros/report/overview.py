"""The picture of the README: what a run found, drawn from the content of its report."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from railtrack_ros.errors import InputError
from railtrack_ros.report import sections, style
from railtrack_ros.report.content import ROLES, Indicators, Report, WaveformPlot
from railtrack_ros.report.curves import LOOK

VIEW = 1.6          # [m] of a waveform


def draw_overview(path: str | Path, report: Report, dots_per_inch: int = 150) -> Path:
    """Draw indicators along the track, contact force and irregularity of one axle box.

    Raises
    ------
    InputError
        The report lacks indicators, irregularity or contact force.
    """
    force = next((p for p in report.waveforms if p.quantity == 'contact force'), None)
    if force is None or report.irregularity is None or report.indicators is None:
        raise InputError('overview: the report has to hold indicators, contact force and '
                         'irregularity')
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(LOOK):
        figure = Figure(figsize=(9.6, 7.4), layout='constrained', facecolor='white')
        along, upper, lower = figure.subplots(3, 1, height_ratios=[1.05, 1, 1])
        _strip(along, report.indicators)
        _waveform(upper, force, report.axle_box, 'Contact force')
        _waveform(lower, report.irregularity, report.axle_box,
                  'Combined irregularity of wheel and rail')
        lower.set_xlabel('position on the track [m]')
        figure.savefig(path, dpi=dots_per_inch)
    return path


def _strip(axes: Axes, data: Indicators) -> None:
    """Draw the band that exceeds its limit most, both rails along the track."""
    found = sections.exceedances(data)
    bands = style.bands(data.rows)
    band = found[0].band if found else bands[0]
    top = 0.0
    for rail in sections.rails(data):
        line = sections.along_rail(data, rail, band)
        edges = np.append(line.start, line.end[-1:])
        axes.stairs(line.mean, edges, baseline=None, label=f'{rail} rail', linewidth=1.8,
                    color=style.RAIL_COLOURS.get(rail, style.MUTED))
        top = max(top, float(np.nanmax(line.mean)))
    if band in data.limits:
        axes.axhline(data.limits[band], color=style.LIMIT, linestyle='--', linewidth=1.2,
                     label='limit')
    for e in (e for e in found if e.band == band):
        axes.axvspan(e.start, e.end, color=style.LIMIT, linewidth=0,
                     alpha=min(0.02 * (e.worst / e.limit)**2, 0.15))
    axes.set_ylim(0, 1.15 * max(top, data.limits.get(band, 0.0)))
    axes.margins(x=0)
    axes.set_ylabel('RMS [µm]')
    axes.set_xlabel('position on the track [m]')
    _title(axes, f'Irregularity of {style.band_title(band)} wavelength along the track')
    _legend(axes)


def _waveform(axes: Axes, plot: WaveformPlot, box: str, title: str) -> None:
    """Draw a short piece in the middle of an axle box's waveform."""
    name = box if box in plot.axle_boxes else next(iter(plot.axle_boxes))
    wave = plot.axle_boxes[name]
    size = len(next(iter(wave.curves.values())))
    half = min(size // 2, round(VIEW / 2 / wave.step))
    part = slice(size // 2 - half, size // 2 + half)
    x = wave.start + wave.step * np.arange(size)
    for role in (r for r in ROLES if r in wave.curves):
        line = style.LINES[role]
        axes.plot(x[part], wave.curves[role][part] * plot.scale, color=line.colour,
                  linewidth=line.width * 0.8, label=line.name)
    axes.margins(x=0)
    axes.set_ylabel(f'{plot.quantity} [{plot.unit}]')
    _title(axes, f'{title}, {style.box_title(name)}')
    _legend(axes)


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc='left', fontsize=11, fontweight='bold')


def _legend(axes: Axes) -> None:
    axes.legend(loc='lower right', bbox_to_anchor=(1.0, 0.97), ncols=4, borderpad=0.2)
