"""Corrugation of the rails on one sheet: the band furthest above its limit, and the spectrogram."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.ticker import FixedLocator, FuncFormatter

from railtrack_ros.irregularity.spectra import iso3095_limit
from railtrack_ros.report import curves, style
from railtrack_ros.report.corrugation import GREY, WAVELENGTHS_MM, CorrugationData, _with_holes

COLOURS = LinearSegmentedColormap.from_list('excess', [
    (0.0, '#f3f7fa'), (1 / 3, '#b9d2e4'), (1 / 3, '#fde3b8'), (0.6, '#ee8a35'), (1.0, '#8f1212')])


def draw_sheet(path: str | Path, data: CorrugationData) -> None:
    """Draw the sheet as .png, .svg or .pdf."""
    count = len(data.rails)
    with curves._figure(path, '', (9.0, 2.6 + 2.2 * count)) as figure:
        axes = figure.subplots(1 + count, 1, sharex=True, height_ratios=[1.2, *[1.0] * count])
        band = _worst(data)
        _strip(axes[0], data, band)
        for place, name in zip(axes[1:], data.rails, strict=True):
            image = _map(place, data, name)
        figure.colorbar(image, ax=list(axes[1:]), label='dB re ISO 3095', pad=0.01)
        axes[-1].set_xlabel('position on the track [m]')


def _worst(data: CorrugationData) -> int:
    """Return the band with the largest ratio to its limit, else the largest RMS."""
    top = np.array([
        max(float(np.max(np.nan_to_num(rail.rms[:, b]), initial=0.0))
            for rail in data.rails.values()) for b in range(len(data.bands))])
    limits = data.limits if data.rms_limits else np.full(top.size, np.nan)
    if np.isfinite(limits).any():
        return int(np.argmax(np.nan_to_num(top / limits)))
    return int(np.argmax(top))


def _strip(axes: Axes, data: CorrugationData, band: int) -> None:
    for name, rail in data.rails.items():
        values = np.where(rail.excluded, np.nan, rail.rms[:, band])
        edges, cells = _with_holes(rail.start, rail.end, values[:, None])
        colour = style.RAIL_COLOURS.get(name, style.MUTED)
        axes.stairs(cells[:, 0], edges, baseline=None, linewidth=1.8, label=f'{name} rail',
                    color=colour)
        struck = np.where(rail.excluded, rail.rms[:, band], np.nan)
        if np.isfinite(struck).any():
            edges, cells = _with_holes(rail.start, rail.end, struck[:, None])
            axes.stairs(cells[:, 0], edges, baseline=None, linewidth=1.2, linestyle=':',
                        label=f'{name}, excluded: impacts', color=colour)
    if data.rms_limits and np.isfinite(data.limits[band]):
        axes.axhline(data.limits[band], color=style.LIMIT, linestyle='--', linewidth=1.2,
                     label=f'limit, {data.limit_title}')
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0)
    axes.set_ylabel('RMS [µm]')
    axes.set_title(f'Combined irregularity, {data.bands[band]}', loc='left', fontsize=11)
    axes.set_ylim(top=1.2 * axes.get_ylim()[1])
    axes.legend(loc='upper right', ncols=3, borderpad=0.1, fontsize='small')


def _map(axes: Axes, data: CorrugationData, name: str) -> QuadMesh:
    rail, half = data.rails[name], 10.0**0.05
    edges = 1e3 * np.append(data.centres * half, data.centres[-1] / half)
    places, cells = _with_holes(
        rail.start, rail.end, rail.combined - iso3095_limit(data.centres))
    axes.set_facecolor(GREY)
    axes.grid(False)
    image = axes.pcolormesh(places, edges, np.ma.masked_invalid(cells.T), cmap=COLOURS, vmin=-10,
                            vmax=20, rasterized=True)
    axes.set_yscale('log')
    axes.yaxis.set_major_locator(FixedLocator([1000, 300, 100, 30, 10]))
    axes.yaxis.set_minor_locator(FixedLocator(list(WAVELENGTHS_MM)))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda *_: ''))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axes.set_ylabel(f'{name} rail [mm]')
    return image
