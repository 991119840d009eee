"""Figures to PNG and CSV files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.rcsetup import cycler

from railtrack_ros.figures.content import Figure, Panel, Surface
from railtrack_ros.output import replacing, write_csv
from railtrack_ros.report import style
from railtrack_ros.report.curves import COLOURS, LOOK

DOTS_PER_INCH = 90
WIDTH, HEIGHT = 7.0, 4.2  # inches of a panel that stands alone
COLOURS_OF_CURVES = (*COLOURS, style.LIMIT, style.MUTED)
DIGITS = 9  # in the CSV: what double precision leaves of a computation


def write_figure(folder: Path, stem: str, figure: Figure) -> list[Path]:
    """Write STEM.png, and STEM.csv or STEM_PANEL.csv of every panel; returns their paths."""
    picture = folder / f'{stem}.png'
    _draw(picture, figure)
    written = [picture]
    for panel in figure.panels:
        path = folder / f'{stem}{"_" if panel.name else ""}{panel.name}.csv'
        write_csv(path, {name: _rounded(values) for name, values in panel.columns().items()})
        written.append(path)
    return written


def _rounded(values: Any) -> list[float]:
    return [float(f'{value:.{DIGITS}g}') for value in values]


def _draw(path: Path, figure: Figure) -> None:
    """Draw all panels of a figure into one picture."""
    columns = figure.columns
    rows = -(-len(figure.panels) // columns)
    size = (max(WIDTH, 4.6 * columns), HEIGHT if rows == 1 else 3.2 * rows)
    with matplotlib.rc_context({**LOOK, 'axes.prop_cycle': cycler(color=COLOURS_OF_CURVES)}):
        canvas = Canvas(figsize=size, layout='constrained', facecolor='white')
        for i, panel in enumerate(figure.panels):
            place = (rows, columns, i + 1)
            if isinstance(panel, Surface):
                _surface(canvas.add_subplot(*place, projection='3d'), panel)
            else:
                _panel(canvas.add_subplot(*place), panel)
        with replacing(path) as part:
            canvas.savefig(part, dpi=DOTS_PER_INCH, metadata=None)


def _panel(axes: Axes, panel: Panel) -> None:
    if panel.logarithmic:
        axes.set(xscale='log', yscale='log')
        axes.grid(which='both')
    _curves(axes, panel)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.x_limits:
        axes.set_xlim(panel.x_limits)
    if panel.y_limits:
        axes.set_ylim(panel.y_limits)
    if panel.title:
        axes.set_title(panel.title, fontsize=10)
    if not panel.logarithmic and (panel.y_limits or np.abs(panel.curves[0].values).max() < 1e-2):
        axes.ticklabel_format(axis='y', style='sci', scilimits=(-2, 4), useMathText=True)
    low, high = axes.get_ylim()
    if panel.supports:
        axes.plot(panel.supports, np.full(len(panel.supports), low), '^', color=style.INK,
                  markersize=7, clip_on=False, label='sleepers')
        axes.set_ylim(low, high)
    if panel.inset is not None:
        small = axes.inset_axes((0.66, 0.1, 0.33, 0.5))
        _curves(small, panel)
        small.set(xlim=panel.inset[0], ylim=panel.inset[1])
        small.tick_params(labelsize=7)
        axes.indicate_inset_zoom(small)
    if len(panel.curves) > 1 or panel.supports:
        axes.legend(fontsize=8, loc='lower left' if panel.inset else 'best')


def _curves(axes: Axes, panel: Panel) -> None:
    for curve in panel.curves:
        axes.plot(panel.x, curve.values, curve.line, label=curve.label, linewidth=1.3)


def _surface(axes: Any, surface: Surface) -> None:
    x, y = np.meshgrid(surface.x, surface.y)
    axes.plot_surface(x, y, surface.z, cmap='viridis', linewidth=0.3, edgecolor='white')
    axes.set(xlabel=surface.labels[0], ylabel=surface.labels[1], zlabel=surface.labels[2])
    axes.view_init(elev=25.0, azim=-50.0)
