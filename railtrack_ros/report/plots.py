"""Plotly figures of the report, one function per figure."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from railtrack_ros.report import sections, style
from railtrack_ros.report.content import (
    ROLES,
    Array,
    ErrorPlot,
    Indicators,
    Latency,
    Spectrum,
    WaveformPlot,
)

WAVELENGTH_TICKS = (2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005)
FREQUENCY_TICKS = (20, 50, 100, 200, 500, 1000, 2000, 5000)
FIRST_VIEW = 3.0      # [m] of a waveform
COARSE = 0.5          # [m] between values that are no waveform: all of them are shown


def waveforms(plot: WaveformPlot) -> go.Figure:
    """Draw one quantity against position, a zoomable stretch; one axle box shown at a time."""
    figure = _figure(390, f'{plot.quantity} [{plot.unit}]')
    shown = next(iter(plot.axle_boxes), None)
    for name, wave in plot.axle_boxes.items():
        for role in (r for r in ROLES if r in wave.curves):
            line = style.LINES[role]
            figure.add_trace(go.Scatter(
                x0=round(wave.start, 6), dx=round(wave.step, 9),
                y=_short(wave.curves[role] * plot.scale), name=line.name, mode='lines',
                line={'color': line.colour, 'width': line.width}, legendgroup=role,
                meta={'axle_box': name}, visible=name == shown, connectgaps=False,
                hovertemplate=f'%{{y:.4~g}} {plot.unit}',
            ))
    figure.update_layout(hovermode='x unified')
    figure.update_xaxes(title_text='position of the axle box on the track [m]',
                        hoverformat='.3f', tickformat='~f')
    if min((wave.step for wave in plot.axle_boxes.values()), default=0.0) < COARSE:
        figure.update_xaxes(range=_first_view(plot),
                            rangeslider={'thickness': 0.1, 'bgcolor': '#f6f8fa'})
    return figure


def spectra(found: Mapping[str, Spectrum]) -> go.Figure:
    """Draw irregularity levels over wavelength, and below them what estimated misses of true."""
    with_truth = any('truth' in s.levels for s in found.values())
    figure = make_subplots(
        rows=2 if with_truth else 1, cols=1, shared_xaxes=True, vertical_spacing=0.06,
        row_heights=[0.7, 0.3] if with_truth else None,
    )
    _layout(figure, 520 if with_truth else 400)
    shown = next(iter(found), None)
    for name, spectrum in found.items():
        for role in (r for r in ('limit', *ROLES) if r in spectrum.levels):
            line = style.LINES[role]
            figure.add_trace(go.Scatter(
                x=_short(spectrum.wavelength), y=_short(spectrum.levels[role]), name=line.name,
                mode='lines' if role == 'limit' else 'lines+markers', legendgroup=role,
                line={'color': line.colour, 'width': max(line.width, 1.8), 'dash': line.dash},
                marker={'size': 8 if role == 'truth' else 5}, meta={'axle_box': name},
                visible=name == shown, hovertemplate='%{y:.1f} dB',
            ), row=1, col=1)
        if with_truth:
            difference = spectrum.levels['estimated'] - spectrum.levels['truth']
            figure.add_trace(go.Bar(
                x=_short(spectrum.wavelength), y=_short(difference), showlegend=False,
                marker_color=style.LINES['estimated'].colour, meta={'axle_box': name},
                name='estimated - true', visible=name == shown, hovertemplate='%{y:+.2f} dB',
                width=_short(spectrum.wavelength * 0.16),
            ), row=2, col=1)
    figure.update_xaxes(type='log', autorange='reversed', **_ticks(WAVELENGTH_TICKS))
    figure.update_yaxes(title_text='level [dB re 1 µm]', row=1, col=1)
    if with_truth:
        figure.add_hrect(y0=-1, y1=1, fillcolor='#5a9c3a', opacity=0.12, line_width=0, row=2,
                         col=1)
        reach = max((float(np.nanmax(np.abs(s.levels['estimated'] - s.levels['truth'])))
                     for s in found.values() if 'truth' in s.levels), default=1.0)
        bound = max(1.5, 1.15 * reach)
        figure.update_yaxes(title_text='error [dB]', range=[-bound, bound], row=2, col=1)
    figure.update_xaxes(title_text='wavelength [m], one-third octaves', row=2 if with_truth else 1,
                        col=1)
    figure.update_layout(hovermode='x unified', bargap=0.5)
    return figure


def band_errors(plot: ErrorPlot) -> go.Figure:
    """Draw level differences, and coherence below, over frequency.

    Lines: the chosen axle box; shades: the range of all.
    """
    with_coherence = any(_known(e.coherence) for boxes in plot.pairs.values()
                         for e in boxes.values())
    figure = make_subplots(rows=2 if with_coherence else 1, cols=1, shared_xaxes=True,
                           vertical_spacing=0.07, row_heights=[0.62, 0.38] if with_coherence
                           else None)
    _layout(figure, 430 if with_coherence else 290)
    reach = 1.0
    for (pair, boxes), colour in zip(plot.pairs.items(), style.PAIR_COLOURS, strict=False):
        shown = next(iter(boxes), None)
        longest = max(boxes.values(), key=lambda b: b.wavelength.size)
        if any(b.wavelength.size != longest.wavelength.size for b in boxes.values()):
            boxes = {name: b for name, b in boxes.items()
                     if b.wavelength.size == longest.wavelength.size}
        frequency = getattr(longest, plot.over)
        together = np.array([b.level_difference for b in boxes.values()])
        good = np.isfinite(together).any(axis=0)
        low, high = (f(together[:, good], axis=0) for f in (np.nanmin, np.nanmax))
        reach = max(reach, float(np.max(np.abs(together[:, good]), initial=0.0)))
        figure.add_trace(go.Scatter(
            x=_short(np.concatenate([frequency[good], frequency[good][::-1]])),
            y=_short(np.concatenate([high, low[::-1]])), fill='toself', mode='lines',
            line={'width': 0}, fillcolor=_faint(colour, 0.16), name=f'{pair}, range',
            hoverinfo='skip', showlegend=False,
        ), row=1, col=1)
        for name, error in boxes.items():
            curve = {'x': _short(getattr(error, plot.over)), 'name': pair, 'mode': 'lines+markers',
                     'line': {'color': colour, 'width': 2}, 'marker': {'size': 5},
                     'meta': {'axle_box': name}, 'visible': name == shown, 'legendgroup': pair,
                     'customdata': _short(error.wavelength * 1e3)}
            figure.add_trace(go.Scatter(
                y=_short(error.level_difference),
                hovertemplate='%{y:+.2f} dB (%{customdata:.3~g} mm)', **curve), row=1, col=1)
            if error.coherence is not None and _known(error.coherence):
                figure.add_trace(go.Scatter(
                    y=_short(error.coherence), showlegend=False,
                    hovertemplate='coherence %{y:.3f}', **curve), row=2, col=1)
    figure.update_yaxes(range=[-1.15 * reach, 1.15 * reach], row=1, col=1)
    figure.update_yaxes(title_text='level difference [dB]', row=1, col=1)
    if with_coherence:
        figure.update_yaxes(title_text='coherence', range=[0, 1.05], row=2, col=1)
    if plot.over == 'wavelength':
        figure.update_xaxes(type='log', autorange='reversed', **_ticks(WAVELENGTH_TICKS))
    else:
        figure.update_xaxes(type='log', **_ticks(FREQUENCY_TICKS))
    axis = 'wavelength [m]' if plot.over == 'wavelength' else 'frequency [Hz]'
    figure.update_xaxes(title_text=f'{axis}, one-third octaves',
                        row=2 if with_coherence else 1, col=1)
    figure.update_layout(hovermode='x unified')
    return figure


def _known(values: Array | None) -> bool:
    """Tell whether there is anything to draw."""
    return values is not None and bool(np.isfinite(values).any())


def latency(data: Latency) -> go.Figure:
    """Draw the delay of each block over time beside its distribution."""
    figure = make_subplots(rows=1, cols=2, shared_yaxes=True, column_widths=[0.74, 0.26],
                           horizontal_spacing=0.02)
    _layout(figure, 320)
    delay = data.delay * 1e3
    step = max(1, data.time.size // 4000)
    figure.add_trace(go.Scatter(
        x=_short(data.time[::step]), y=_short(delay[::step]), mode='markers', name='each block',
        marker={'size': 3.5, 'color': style.LINES['estimated'].colour, 'opacity': 0.45},
        hovertemplate='%{y:.2f} ms',
    ), row=1, col=1)
    centres, percentiles = _percentiles(data.time, delay)
    for value, dash in ((50, 'solid'), (99, 'dot')):
        figure.add_trace(go.Scatter(
            x=_short(centres), y=_short(percentiles[value]), mode='lines',
            name='median' if value == 50 else f'{value} %',
            line={'color': style.INK, 'width': 1.8, 'dash': dash}, hovertemplate='%{y:.2f} ms',
        ), row=1, col=1)
    figure.add_trace(go.Histogram(
        y=_short(delay), nbinsy=60, showlegend=False, name='blocks',
        marker_color=style.LINES['estimated'].colour, hovertemplate='%{x} blocks at %{y} ms',
    ), row=1, col=2)
    top = float(delay.max()) * 1.15
    if data.real_time_limit is not None:
        limit = data.real_time_limit * 1e3
        top = max(top, 1.2 * limit)
        figure.add_hline(y=limit, line={'color': style.LIMIT, 'width': 1.4, 'dash': 'dash'})
        figure.add_annotation(
            x=0, y=limit, xref='x domain', yref='y', xanchor='left', yanchor='bottom',
            text=f'length of a block, {limit:g} ms', showarrow=False,
            font={'color': style.LIMIT, 'size': 12})
    figure.update_yaxes(range=[0, top])
    figure.update_yaxes(title_text='latency [ms]', row=1, col=1)
    figure.update_xaxes(title_text='time since the start [s]', row=1, col=1)
    figure.update_xaxes(title_text='blocks', row=1, col=2)
    return figure


def strip_chart(data: Indicators, highlight: tuple[float, float] | None = None) -> go.Figure:
    """Draw the RMS of each band along the track per rail, sections above a limit shaded."""
    bands = style.bands(data.rows)
    figure = make_subplots(rows=len(bands), cols=1, shared_xaxes=True, vertical_spacing=0.045)
    _layout(figure, 150 * len(bands) + 90)
    for i, band in enumerate(bands, start=1):
        top, resolved = data.limits.get(band, 0.0), False
        for rail in sections.rails(data):
            found = sections.along_rail(data, rail, band)
            resolved |= bool(np.isfinite(found.mean).any())
            top = max(top, float(np.max(np.nan_to_num(found.high), initial=0.0)))
            _steps(figure, found, rail, i)
        limit = data.limits.get(band)
        if limit is not None and resolved:
            figure.add_hline(y=limit, row=i, col=1,
                             line={'color': style.LIMIT, 'width': 1.3, 'dash': 'dash'})
            for e in (e for e in sections.exceedances(data) if e.band == band):
                figure.add_vrect(x0=e.start, x1=e.end, fillcolor=style.LIMIT, line_width=0, row=i,
                                 col=1, layer='below',
                                 opacity=min(0.02 * (e.worst / e.limit)**2, 0.14))
        text = style.band_title(band)
        text = f'<b>{text}</b>' if resolved else f'{text}: not resolved at this speed and rate'
        figure.add_annotation(x=0.006, y=0.96, xref='x domain', yref='y domain', text=text,
                              showarrow=False, xanchor='left', yanchor='top', row=i, col=1,
                              bgcolor='rgba(255,255,255,0.75)')
        figure.update_yaxes(title_text='RMS [µm]', range=[0, 1.3 * top or 1.0], row=i, col=1)
    if highlight is not None:
        figure.add_vrect(x0=highlight[0], x1=highlight[1], fillcolor='rgba(0,0,0,0)', row='all',
                         col=1, line={'color': style.MUTED, 'width': 1, 'dash': 'dot'})
    if data.limits:
        figure.add_trace(go.Scatter(
            x=[None], y=[None], mode='lines', name='limit',
            line={'color': style.LIMIT, 'width': 1.3, 'dash': 'dash'}), row=1, col=1)
    figure.update_xaxes(title_text='position on the track [m]', row=len(bands), col=1)
    return figure


def heat_map(data: Indicators) -> go.Figure:
    """Draw every axle box against position, RMS in dB re the limit; buttons choose the band."""
    boxes = [box for _, box in sorted({(str(r['rail']), str(r['axle_box'])) for r in data.rows})]
    starts = sorted({sections.number(row['from_m']) for row in data.rows})
    ends = {sections.number(r['from_m']): sections.number(r['to_m']) for r in data.rows}
    values = {}
    for band, limit in data.limits.items():
        z = np.full((len(boxes), len(starts)), np.nan)
        for row in data.rows:
            value = sections.number(row.get(band))
            if value > 0:
                place = boxes.index(str(row['axle_box'])), starts.index(
                    sections.number(row['from_m']))
                z[place] = 20 * np.log10(value / limit)
        if np.isfinite(z).any():
            values[band] = z
    figure = _figure(max(210, 95 + 26 * len(boxes)), '')
    worst = max(values, key=lambda b: float(np.nanmax(values[b])), default=None)
    for band, z in values.items():
        figure.add_trace(go.Heatmap(
            x=[*starts, ends[starts[-1]]], y=[style.box_title(b) for b in boxes], z=_short(z),
            visible=band == worst, zmin=-20, zmax=20, xgap=0.5, ygap=2, hoverongaps=False,
            colorscale=[[0, '#eef3f7'], [0.5, '#c9d8e4'], [0.5, '#fbd9a5'], [0.75, '#ea7a2b'],
                        [1, '#8f1212']],
            colorbar={'title': {'text': 'dB re limit'}, 'thickness': 12, 'outlinewidth': 0,
                      'tickvals': [-20, -10, 0, 10, 20]},
            hovertemplate='%{y}, from %{x} m: %{z:+.1f} dB<extra></extra>',
        ))
    names = list(values)
    figure.update_layout(updatemenus=[{
        'type': 'buttons', 'direction': 'right', 'x': 0, 'xanchor': 'left', 'y': 1.02,
        'yanchor': 'bottom', 'active': names.index(worst) if worst else 0, 'pad': {'t': 0},
        'font': {'size': 12}, 'bordercolor': style.GRID, 'bgcolor': '#ffffff',
        'buttons': [{'label': style.band_title(band), 'method': 'restyle',
                     'args': ['visible', [other == band for other in names]]} for band in names],
    }], margin={'t': 45, 'l': 105})
    figure.update_yaxes(autorange='reversed', showgrid=False, ticks='')
    figure.update_xaxes(title_text='position on the track [m]', showgrid=False)
    return figure


def _steps(figure: go.Figure, found: sections.RailBand, rail: str, row: int) -> None:
    """One rail in a strip: range over its axle boxes as a band, their mean as a stepped line."""
    colour = style.RAIL_COLOURS.get(rail, style.MUTED)
    x = np.column_stack([found.start, found.end]).ravel()
    low, mean, high = (np.repeat(v, 2) for v in (found.low, found.mean, found.high))
    good = np.isfinite(mean)
    if (found.high[np.isfinite(found.high)] > found.low[np.isfinite(found.low)]).any():
        figure.add_trace(go.Scatter(
            x=_short(np.concatenate([x[good], x[good][::-1]])),
            y=_short(np.concatenate([high[good], low[good][::-1]])), fill='toself', mode='lines',
            line={'width': 0}, fillcolor=_faint(colour, 0.22), hoverinfo='skip',
            showlegend=False, name=rail,
        ), row=row, col=1)
    figure.add_trace(go.Scatter(
        x=_short(x), y=_short(mean), mode='lines', name=f'{rail} rail', legendgroup=rail,
        showlegend=row == 1, line={'color': colour, 'width': 2},
        hovertemplate=f'{rail}: %{{y:.2f}} µm<extra></extra>',
    ), row=row, col=1)


def _first_view(plot: WaveformPlot) -> list[float]:
    """Return the part shown at first [m]: as much as lets single waves be told apart."""
    starts = [w.start for w in plot.axle_boxes.values()]
    ends = [w.start + w.step * (len(next(iter(w.curves.values()))) - 1)
            for w in plot.axle_boxes.values()]
    middle = (max(starts) + min(ends)) / 2
    half = min(FIRST_VIEW, min(ends) - max(starts)) / 2
    return [middle - half, middle + half]


def _percentiles(time: Array, delay: Array) -> tuple[Array, dict[int, Array]]:
    """Median and 99 % of the delay in windows of a second (at most 200 of them)."""
    width = max(1.0, float(time[-1] - time[0]) / 200)
    window = ((time - time[0]) // width).astype(int)
    numbers = np.unique(window)
    values = {p: np.array([np.percentile(delay[window == k], p) for k in numbers])
              for p in (50, 99)}
    return time[0] + (numbers + 0.5) * width, values


def _figure(height: int, y_title: str) -> go.Figure:
    figure = go.Figure()
    _layout(figure, height)
    figure.update_yaxes(title_text=y_title)
    return figure


def _layout(figure: go.Figure, height: int) -> None:
    figure.update_layout(
        template='none', height=height, margin={'l': 72, 'r': 18, 't': 30, 'b': 52},
        font={'family': style.FONT, 'size': 13, 'color': style.INK}, paper_bgcolor='#ffffff',
        plot_bgcolor='#ffffff', dragmode='zoom', hoverlabel={'font': {'size': 12}},
        legend={'orientation': 'h', 'x': 0, 'xanchor': 'left', 'y': 1.01, 'yanchor': 'bottom',
                'font': {'size': 12.5}},
    )
    axes = {'gridcolor': style.GRID, 'zeroline': False, 'linecolor': '#b8c0c8', 'showline': True,
            'ticks': 'outside', 'tickcolor': '#b8c0c8', 'ticklen': 4, 'automargin': True,
            'title': {'font': {'size': 13, 'color': style.MUTED}, 'standoff': 8}}
    figure.update_xaxes(**axes)
    figure.update_yaxes(**axes)


def _ticks(values: tuple[float, ...]) -> dict:
    return {'tickvals': list(values), 'ticktext': [f'{v:g}' for v in values]}


def _short(values: Array) -> np.ndarray:
    """Single precision: what a screen shows, in half of the page's size."""
    return np.asarray(values, dtype=np.float32)


def _faint(colour: str, opacity: float) -> str:
    red, green, blue = (int(colour[i:i + 2], 16) for i in (1, 3, 5))
    return f'rgba({red},{green},{blue},{opacity})'
