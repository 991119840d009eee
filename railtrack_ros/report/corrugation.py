"""Plots of corrugation along the rails: strip chart, spectrogram, spectrum, exceedance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from railtrack_ros.irregularity.spectra import iso3095_limit
from railtrack_ros.report import plots, style
from railtrack_ros.report.content import Array, Card

GREY = '#d5dade'
WAVELENGTHS_MM = (1000.0, 500.0, 300.0, 200.0, 100.0, 50.0, 30.0, 20.0, 10.0)

# Classes of the share of a section that is above the limit [%]; the first is none at all.
CLASSES = (0.0, 5.0, 10.0, 25.0, 50.0, 75.0, 100.0)

BAND_COLOURS = ('#5a9c3a', '#e0800a', '#1456a0', '#8a3f9e', '#66727f')


@dataclass(frozen=True)
class RailData:
    """Sections of one rail in order of their place, n of them, NaN where not resolved.

    start, end (n,) [m]; excluded (n,) bool; rms (n, bands) [um]; spread (n, bands) [dB] between
    the axle boxes; above (n, bands) [%] of the section; combined and rail (n, k): levels in
    one-third octaves [dB re 1 um] as measured, and freed of the contact filter.
    """

    start: Array
    end: Array
    excluded: np.ndarray
    rms: Array
    spread: Array
    above: Array
    combined: Array
    rail: Array


@dataclass(frozen=True)
class CorrugationData:
    """What the plots show: bands by title, limits [um] (NaN: none), centres (k,) [m], rails.

    rms_limits: whether the limits are those of an RMS, and can be drawn in the strip chart.
    """

    bands: Sequence[str]
    limits: Array
    limit_title: str
    rms_limits: bool
    centres: Array
    rails: Mapping[str, RailData]
    contact_filter: str


def card(data: CorrugationData) -> Card:
    """Return all plots as a part of the page."""
    resolved = 'Grey: not resolved at this speed and sample rate, or not valid.'
    return Card('Corrugation of the rails', [
        ('Along the track',
         'RMS of the combined irregularity in each section, wheels set apart where they could be, '
         'all axle boxes fused; band: one standard deviation between them. Dotted: excluded for '
         f'impacts, as over joints and switches. {resolved}', strip_chart(data)),
        ('Wavelength and place',
         'Level in one-third octaves relative to the limit of ISO 3095, combined and indirect. '
         f'{resolved}', spectrogram(data)),
        ('Spectrum against ISO 3095',
         'Energy mean of the sections that are not excluded, and the worst section. Combined: as '
         f'measured; rail: freed of the contact filter ({data.contact_filter}), given from 20 mm '
         'on.', spectrum(data)),
        ('Exceedance',
         f'Which share of a section is above the limit of {data.limit_title}, and of how many '
         'sections that is so.', exceedance(data)),
    ])  # fmt: skip


def strip_chart(data: CorrugationData) -> go.Figure:
    """Draw the RMS of every band along the track, both rails."""
    bands = list(data.bands)
    figure = make_subplots(rows=len(bands), cols=1, shared_xaxes=True, vertical_spacing=0.045)
    plots._layout(figure, 150 * len(bands) + 90)
    first, last = _extent(data)
    for b, title in enumerate(bands):
        row, limit = b + 1, data.limits[b]
        tops = [0.0]
        for name, rail in data.rails.items():
            tops.append(float(np.max(np.nan_to_num(rail.rms[:, b]), initial=0.0)))
            _steps(figure, rail, b, name, row)
        resolved = max(tops) > 0.0
        if data.rms_limits and math.isfinite(limit) and resolved:
            tops.append(1.1 * limit)
            figure.add_hline(y=limit, row=row, col=1,
                             line={'color': style.LIMIT, 'width': 1.3, 'dash': 'dash'})
        text = f'<b>{title}</b>' if resolved else f'{title}: not resolved at this speed and rate'
        for begin, end in _gaps(data, b) if resolved else [(first, last)]:
            figure.add_vrect(x0=begin, x1=end, fillcolor=GREY, line_width=0, row=row, col=1,
                             layer='below', opacity=0.6)
        figure.add_annotation(x=0.006, y=0.96, xref='x domain', yref='y domain', text=text,
                              showarrow=False, xanchor='left', yanchor='top', row=row, col=1,
                              bgcolor='rgba(255,255,255,0.75)')
        figure.update_yaxes(title_text='RMS [µm]', range=[0, 1.3 * max(tops) or 1.0], row=row,
                            col=1)
    if data.rms_limits:
        figure.add_trace(go.Scatter(
            x=[None], y=[None], mode='lines', name=f'limit, {data.limit_title}',
            line={'color': style.LIMIT, 'width': 1.3, 'dash': 'dash'}), row=1, col=1)
    figure.update_xaxes(title_text='position on the track [m]', row=len(bands), col=1)
    figure.update_xaxes(range=[first, last])
    return figure


def spectrogram(data: CorrugationData) -> go.Figure:
    """Draw the levels above ISO 3095 over place and wavelength, one map a rail."""
    names = list(data.rails)
    figure = make_subplots(rows=len(names), cols=1, shared_xaxes=True, vertical_spacing=0.07,
                           subplot_titles=[f'{name} rail' for name in names])
    plots._layout(figure, 240 * len(names) + 90)
    limit = iso3095_limit(data.centres)
    half = 10.0**0.05
    edges = 1e3 * np.append(data.centres * half, data.centres[-1] / half)
    for row, name in enumerate(names, start=1):
        rail = data.rails[name]
        places, table = _with_holes(rail.start, rail.end, rail.combined - limit)
        figure.add_trace(go.Heatmap(
            x=plots._short(places), y=plots._short(edges), z=plots._short(table.T), zmin=-10,
            zmax=20, hoverongaps=False, coloraxis='coloraxis',
            hovertemplate='%{x:.0f} m, %{y:.3~g} mm: %{z:+.1f} dB<extra></extra>',
        ), row=row, col=1)
    figure.update_yaxes(type='log', title_text='wavelength [mm]', tickvals=WAVELENGTHS_MM,
                        ticktext=[f'{w:g}' for w in WAVELENGTHS_MM], showgrid=False)
    figure.update_xaxes(showgrid=False)
    figure.update_xaxes(title_text='position on the track [m]', row=len(names), col=1)
    figure.update_layout(
        plot_bgcolor=GREY, margin={'t': 45},
        coloraxis={'cmin': -10, 'cmax': 20, 'colorscale': [
            [0, '#f3f7fa'], [1 / 3, '#b9d2e4'], [1 / 3, '#fde3b8'], [0.6, '#ee8a35'],
            [1, '#8f1212']],
            'colorbar': {'title': {'text': 'dB re ISO 3095'}, 'thickness': 12, 'outlinewidth': 0}})
    return figure


def spectrum(data: CorrugationData) -> go.Figure:
    """Draw mean and worst spectrum of each rail against the limit."""
    figure = plots._figure(430, 'level [dB re 1 µm]')
    wavelength = 1e3 * data.centres
    figure.add_trace(go.Scatter(
        x=plots._short(wavelength), y=plots._short(iso3095_limit(data.centres)), mode='lines',
        name='limit of ISO 3095', line={'color': style.LIMIT, 'width': 1.8, 'dash': 'dash'},
        hovertemplate='%{y:.1f} dB'))
    limit = iso3095_limit(data.centres)
    for name, rail in data.rails.items():
        colour = style.RAIL_COLOURS.get(name, style.MUTED)
        good = ~rail.excluded
        if not good.any() or not np.isfinite(rail.combined[good]).any():
            continue
        over = np.where(np.isfinite(rail.combined), rail.combined - limit, -np.inf).max(axis=1)
        worst = int(np.argmax(np.where(good, over, -np.inf)))
        place = f'{rail.start[worst]:g}-{rail.end[worst]:g} m'
        for label, levels, dash, width in (
            (f'{name} rail, combined', energy_mean(rail.combined[good]), 'solid', 2.2),
            (f'{name} rail, without contact filter', energy_mean(rail.rail[good]), 'dot', 2.2),
            (f'{name} rail, worst section {place}', rail.combined[worst], 'solid', 0.9),
        ):
            figure.add_trace(go.Scatter(
                x=plots._short(wavelength), y=plots._short(levels), mode='lines+markers',
                name=label, marker={'size': 4}, hovertemplate='%{y:.1f} dB',
                line={'color': colour, 'width': width, 'dash': dash}))
    figure.add_vrect(x0=8.0, x1=20.0 / 10**0.05, fillcolor=GREY, line_width=0, opacity=0.5,
                     layer='below', annotation_text='not absolute',
                     annotation_position='bottom right')
    figure.update_xaxes(type='log', range=[math.log10(1150.0), math.log10(8.5)],
                        title_text='wavelength, one-third octaves [mm]', tickvals=WAVELENGTHS_MM,
                        ticktext=[f'{w:g}' for w in WAVELENGTHS_MM])
    figure.update_layout(hovermode='x unified', margin={'t': 75})
    return figure


def exceedance(data: CorrugationData) -> go.Figure:
    """Draw of how many sections which share is above the limit, by band."""
    figure = plots._figure(330, 'share of all sections [%]')
    labels = ['nothing', *(f'{a:g}-{b:g} %' for a, b in zip(CLASSES, CLASSES[1:], strict=False))]
    for b, title in enumerate(data.bands):
        values = np.concatenate([
            rail.above[~rail.excluded, b] for rail in data.rails.values()])
        values = values[np.isfinite(values)]
        if not values.size:
            continue
        counts = [np.count_nonzero(values <= 0.0), *(
            np.count_nonzero((values > low) & (values <= high))
            for low, high in zip(CLASSES, CLASSES[1:], strict=False))]
        figure.add_trace(go.Bar(
            x=labels, y=plots._short(100.0 * np.array(counts) / values.size), name=title,
            marker_color=BAND_COLOURS[b % len(BAND_COLOURS)],
            hovertemplate=f'{title}: %{{y:.1f}} % of {values.size} sections<extra></extra>'))
    figure.update_layout(barmode='group', bargap=0.25)
    figure.update_yaxes(range=[0, 105])
    figure.update_xaxes(title_text='share of the section above the limit')
    return figure


def wheel_orders(wheels: Mapping[str, tuple[Array, Array]]) -> go.Figure:
    """Draw the out-of-roundness of wheels by order.

    By axle box: amplitudes and their standard deviations (orders,) [um].
    """
    figure = plots._figure(340, 'amplitude [µm]')
    for number, (name, (amplitude, uncertainty)) in enumerate(wheels.items()):
        orders = np.arange(1, amplitude.size + 1)
        figure.add_trace(go.Scatter(
            x=orders + 0.06 * (number - 0.5 * (len(wheels) - 1)), y=plots._short(amplitude),
            mode='lines+markers', name=style.box_title(name), line={'width': 0.8},
            marker={'size': 6}, customdata=orders,
            error_y={'array': plots._short(uncertainty), 'thickness': 1.0, 'width': 2},
            hovertemplate='order %{customdata}: %{y:.1f} µm'))
    figure.update_xaxes(title_text='order', dtick=1, range=[0.4, 20.6])
    figure.update_yaxes(rangemode='tozero')
    figure.update_layout(margin={'t': 75})
    return figure


def energy_mean(levels: Array) -> Array:
    """Energy mean of levels (n, k) [dB] over n, NaN where none is given."""
    given = np.isfinite(levels)
    power = np.where(given, 10.0 ** (0.1 * np.nan_to_num(levels)), 0.0).sum(axis=0)
    count = given.sum(axis=0)
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.where(count > 0, 10.0 * np.log10(power / count), np.nan)


def _with_holes(start: Array, end: Array, values: Array) -> tuple[Array, Array]:
    """Edges (m + 1,) and values (m, k) of cells along the track, NaN where sections are missing."""
    edges, rows = [start[0]], []
    for a, b, row in zip(start, end, values, strict=True):
        if a > edges[-1] + 1e-6:
            edges.append(a)
            rows.append(np.full(row.shape, np.nan))
        edges.append(b)
        rows.append(row)
    return np.array(edges), np.array(rows)


def _extent(data: CorrugationData) -> tuple[float, float]:
    rails = [rail for rail in data.rails.values() if rail.start.size]
    return (min(float(rail.start[0]) for rail in rails),
            max(float(rail.end[-1]) for rail in rails))


def _gaps(data: CorrugationData, band: int) -> list[tuple[float, float]]:
    """Return the stretches [m] over which no rail has the band."""
    first, last = _extent(data)
    known = sorted((float(a), float(b)) for rail in data.rails.values() for a, b, v in zip(
        rail.start, rail.end, rail.rms[:, band], strict=True) if math.isfinite(v))
    gaps, reached = [], first
    for begin, end in known:
        if begin > reached + 1e-6:
            gaps.append((reached, begin))
        reached = max(reached, end)
    return [*gaps, (reached, last)] if last > reached + 1e-6 else gaps


def _steps(figure: go.Figure, rail: RailData, band: int, name: str, row: int) -> None:
    """One rail in a strip: spread as a band, the fused value as a stepped line."""
    colour = style.RAIL_COLOURS.get(name, style.MUTED)
    x = np.column_stack([rail.start, rail.end]).ravel()
    value = np.repeat(np.where(rail.excluded, np.nan, rail.rms[:, band]), 2)
    spread = np.repeat(np.nan_to_num(rail.spread[:, band]), 2)
    good = np.isfinite(value)
    if good.any() and spread[good].any():
        high, low = value[good] * 10 ** (spread[good] / 20), value[good] * 10 ** (
            -spread[good] / 20)
        figure.add_trace(go.Scatter(
            x=plots._short(np.concatenate([x[good], x[good][::-1]])),
            y=plots._short(np.concatenate([high, low[::-1]])), fill='toself', mode='lines',
            line={'width': 0}, fillcolor=plots._faint(colour, 0.22), hoverinfo='skip',
            showlegend=False, name=name), row=row, col=1)
    figure.add_trace(go.Scatter(
        x=plots._short(x), y=plots._short(value), mode='lines', name=f'{name} rail',
        legendgroup=name, showlegend=row == 1, line={'color': colour, 'width': 2},
        hovertemplate=f'{name}: %{{y:.2f}} µm<extra></extra>'), row=row, col=1)
    struck = np.repeat(np.where(rail.excluded, rail.rms[:, band], np.nan), 2)
    if np.isfinite(struck).any():
        figure.add_trace(go.Scatter(
            x=plots._short(x), y=plots._short(struck), mode='lines', legendgroup='struck',
            name='excluded: impacts', showlegend=row == 2 and name == 'left',
            line={'color': colour, 'width': 1.2, 'dash': 'dot'},
            hovertemplate=f'{name}, excluded: %{{y:.2f}} µm<extra></extra>'), row=row, col=1)
