"""Plots of the track in the frequency domain, as PNG, SVG or PDF files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from railtrack_ros.errors import InputError
from railtrack_ros.output import replacing
from railtrack_ros.report import style

Array = NDArray[np.floating[Any]]

DECIBELS = 20.0 / np.log(10.0)  # dB of a decay by exp(-1)
FORMATS = ('.png', '.svg', '.pdf')
COLOURS = ('#1456a0', '#e0800a', '#5a9c3a', '#8a3f9e')
LOOK = {
    'font.size': 10, 'axes.edgecolor': '#b8c0c8', 'axes.labelcolor': style.MUTED,
    'text.color': style.INK, 'xtick.color': style.MUTED, 'ytick.color': style.MUTED,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.grid': True,
    'grid.color': style.GRID, 'axes.axisbelow': True, 'legend.frameon': False,
    'axes.prop_cycle': cycler(color=COLOURS), 'svg.hashsalt': 'railtrack',
}


@dataclass(frozen=True)
class Mark:
    """A named point of a curve; the name stands above and right of it, or below and left."""

    label: str
    frequency: float
    value: float
    below: bool = False


def check_format(path: str | Path) -> None:
    """Raise InputError unless the file name ends as one of the formats."""
    if Path(path).suffix.lower() not in FORMATS:
        raise InputError(f'{path}: a plot is written as {", ".join(FORMATS)}')


def draw_receptance(
    path: str | Path, frequency: Array, curves: Mapping[str, NDArray[Any]],
    marks: Sequence[Mark] = (), title: str = '', quantity: str = 'receptance [m/N]',
) -> None:
    """Draw magnitude and phase of complex curves (f,) over frequency (f,) [Hz]."""
    order = np.argsort(frequency)
    frequency = frequency[order]
    with _figure(path, title, (8.0, 6.0)) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
        for label, values in curves.items():
            values = values[order]
            dots = 'o' if len(values) < 25 else None
            upper.plot(frequency, np.abs(values), label=label, marker=dots, markersize=4)
            lower.plot(frequency, np.degrees(np.angle(values)), marker=dots, markersize=4)
        _marks(upper, marks)
        upper.margins(y=0.2 if marks else 0.05)
        upper.set(yscale='log', ylabel=f'|{quantity.split(" [")[0]}| [{quantity.split(" [")[1]}')
        lower.set(ylabel='phase [°]', xlabel='frequency [Hz]', ylim=(-185.0, 185.0),
                  yticks=[-180, -90, 0, 90, 180])
        if frequency[-1] > 10.0 * frequency[0]:
            _octave_axis(lower, frequency)
        upper.legend()


def draw_decay_rate(
    path: str | Path, frequency: Array, curves: Mapping[str, Array],
    band: tuple[str, Array, Array] | None = None, limit: tuple[Array, Array] | None = None,
    title: str = '',
) -> None:
    """Draw decay rates (f,) [dB/m] over one-third octaves, frequency (f,) [Hz].

    band: label, lower and upper values of a scatter; limit: frequencies and values of the lower
    limit of ISO 3095.
    """
    with _figure(path, title, (8.0, 4.8)) as figure:
        axes = figure.subplots()
        if band is not None:
            axes.fill_between(frequency, band[1], band[2], color='#aab4be', alpha=0.4,
                              linewidth=0.0, label=band[0])
        for label, values in curves.items():
            axes.plot(frequency, values, marker='o', markersize=4, label=label)
        if limit is not None:
            axes.plot(*limit, color=style.LIMIT, linestyle='--', linewidth=1.4,
                      label='lower limit, ISO 3095:2013')
        axes.set(ylabel='decay rate [dB/m]', xlabel='frequency, one-third octaves [Hz]')
        _decibel_axis(axes)
        _octave_axis(axes, frequency)
        axes.legend()


def draw_dispersion(
    path: str | Path, frequency: Array, wavenumber: NDArray[Any], spacing: float, title: str = '',
) -> None:
    """Draw real part and decay of Bloch wavenumbers (f, 2) [1/m] over frequency (f,) [Hz].

    spacing [m] of the sleepers places the stop bands, at multiples of pi / spacing.
    """
    order = np.argsort(frequency)
    frequency, wavenumber = frequency[order], wavenumber[order]
    with _figure(path, title, (8.0, 6.0)) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        for branch, label in ((0, 'far-reaching wave'), (1, 'near field')):
            upper.plot(frequency, wavenumber[:, branch].real, label=label)
            lower.plot(frequency, -DECIBELS * wavenumber[:, branch].imag)
        top = float(wavenumber.real.max())
        for n in range(1, int(top * spacing / np.pi) + 1):
            upper.axhline(n * np.pi / spacing, color=style.MUTED, linewidth=0.8, linestyle=':')
            upper.annotate(f'{n if n > 1 else ""}π/l', (frequency[0], n * np.pi / spacing),
                           color=style.MUTED, fontsize=8, va='bottom')
        upper.set(ylabel='Re wavenumber [rad/m]')
        lower.set(ylabel='decay, -Im wavenumber [dB/m]', xlabel='frequency [Hz]')
        _decibel_axis(lower)
        upper.legend()


@contextmanager
def _figure(path: str | Path, title: str, size: tuple[float, float]) -> Iterator[Figure]:
    """Give a figure which is written to `path` at the end of the block."""
    check_format(path)
    with matplotlib.rc_context(LOOK):
        figure = Figure(figsize=size, layout='constrained', facecolor='white')
        yield figure
        if title:
            figure.suptitle(title, x=0.02, ha='left', fontsize=11)
        with replacing(path) as place:
            undated = {'.png': None, '.svg': {'Date': None}, '.pdf': {'CreationDate': None}}
            figure.savefig(place, dpi=150, metadata=undated[Path(path).suffix.lower()])


def _marks(axes: Axes, marks: Sequence[Mark]) -> None:
    """Name points of the curves."""
    for mark in marks:
        axes.plot(mark.frequency, mark.value, 'o', color=style.INK, markersize=4)
        axes.annotate(f'{mark.label}\n{mark.frequency:.0f} Hz', (mark.frequency, mark.value),
                      xytext=(-4, -4) if mark.below else (4, 4), textcoords='offset points',
                      ha='right' if mark.below else 'left',
                      va='top' if mark.below else 'bottom', fontsize=8)


def _decibel_axis(axes: Axes) -> None:
    """Make the axis of decay rates logarithmic with round numbers on it."""
    axes.set_yscale('log')
    axes.yaxis.set_major_locator(FixedLocator([0.01, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100]))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))


def _octave_axis(axes: Axes, frequency: Array) -> None:
    """Make the frequency axis logarithmic with round numbers on it."""
    axes.set_xscale('log')
    low, high = float(frequency.min()), float(frequency.max())
    ticks = [m * 10.0**e for e in range(-3, 5) for m in (1, 2, 5)]
    axes.xaxis.set_major_locator(FixedLocator([t for t in ticks if low <= t <= high]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
