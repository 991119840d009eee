"""The HTML report: one file that opens from disk, with no network access and readable on paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from railtrack_ros import __version__
from railtrack_ros.errors import InputError
from railtrack_ros.output import replacing
from railtrack_ros.report import plots, sections, style
from railtrack_ros.report.content import Report, Table, Tile

TABLE_ROWS = 25


def write_report(path: str | Path, report: Report) -> Path:
    """Write ``report`` as a self-contained HTML file; a half-written one never stands there."""
    try:
        with replacing(path) as place:
            place.write_text(render(report), encoding='utf-8')
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror or error})') from error
    return Path(path)


def render(report: Report) -> str:
    """Return the page as text."""
    page = _Page()
    body = ''.join(_cards(report, page))
    return _PAGE.format(
        title=escape(report.title), subtitle=escape(report.subtitle), version=__version__,
        styles=_asset('page.css'), plotly=get_plotlyjs(), script=_asset('page.js'),
        findings=''.join(f'<li>{escape(text)}</li>' for text in report.findings),
        tiles=''.join(_tile(tile) for tile in report.tiles), body=body,
        boxes=_box_choice(report),
    )


class _Page:
    """Numbers the figures of a page and keeps them next to their places."""

    def __init__(self) -> None:
        self.count = 0

    def figure(self, figure: go.Figure, label: str) -> str:
        self.count += 1
        data = figure.to_json(engine='json').replace('</', '<\\/')
        return (
            f'<div class="plot" id="plot-{self.count}" role="img" aria-label="{escape(label)}"'
            f' style="min-height:{int(figure.layout.height)}px"></div>'
            f'<script type="application/json" class="figure" data-plot="plot-{self.count}">'
            f'{data}</script>'
        )


def _cards(report: Report, page: _Page) -> Iterable[str]:
    for card in report.cards:
        yield _card(card.title, *(
            f'<h3>{escape(heading)}</h3>{_note(remark)}{page.figure(figure, heading)}'
            for heading, remark, figure in card.figures), *map(_table, card.tables))
    if report.indicators is not None and report.indicators.rows:
        found = sections.exceedances(report.indicators)
        parts = [
            _note('Root mean square of the combined irregularity in each section, through the '
                  'causal filters of the live node; thick line: mean over the axle boxes of a '
                  'rail, band: their range. Shaded: above the limit.'
                  + (' Dotted frame: the stretch replayed through the full model.'
                     if report.highlight else '')),
            page.figure(plots.strip_chart(report.indicators, report.highlight),
                        'irregularity in wavelength bands along the track'),
        ]
        if report.indicators.limits:
            parts += [
                '<h3>Every axle box, relative to the limit</h3>',
                page.figure(plots.heat_map(report.indicators), 'level of each axle box'),
                _table(_stretches(found, report.indicators.limit_source)),
            ]
        yield _card('Corrugation by axle box, as told live', *parts)
    if report.irregularity is not None or report.spectra:
        parts = []
        if report.irregularity is not None:
            parts += [_note(report.irregularity.remark),
                      page.figure(plots.waveforms(report.irregularity), 'irregularity')]
        if report.spectra:
            parts += ['<h3>Spectrum in one-third octaves</h3>', _note(report.spectrum_remark),
                      page.figure(plots.spectra(report.spectra), 'irregularity spectrum')]
        yield _card('Irregularity', *parts)
    for plot in report.waveforms:
        yield _card(plot.title, _note(plot.remark),
                    page.figure(plots.waveforms(plot), plot.quantity))
    if report.errors or report.tables:
        parts = []
        for error in report.errors:
            parts += [f'<h3>{escape(error.title)}</h3>', _note(error.remark),
                      page.figure(plots.band_errors(error), error.title)]
        title = 'How well they agree' if report.errors else 'In figures'
        yield _card(title, *parts, *(_table(t) for t in report.tables))
    if report.latency is not None and report.latency.delay.size:
        yield _card('Live latency', _note(report.latency.definition),
                    page.figure(plots.latency(report.latency), 'latency'))
    if report.parameters or report.methods:
        yield _card(
            'How it was computed',
            ''.join(f'<p>{escape(text)}</p>' for text in report.methods),
            '<div class="groups">' + ''.join(
                f'<div><h3>{escape(group)}</h3><table class="parameters">' + ''.join(
                    f'<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>'
                    for k, v in values.items()) + '</table></div>'
                for group, values in report.parameters.items()) + '</div>',
        )


def _stretches(found: Sequence[sections.Exceedance], source: str) -> Table:
    rows = [[
        e.rail, f'{e.start:.0f} - {e.end:.0f}', f'{e.end - e.start:.0f}',
        style.band_title(e.band), f'{e.worst:.1f}', f'{e.limit:g}',
        f'{e.worst / e.limit:.1f}',
        '' if e.wavelength is None else f'{e.wavelength * 1e3:.0f}',
    ] for e in found[:TABLE_ROWS]]
    remark = source if len(found) <= TABLE_ROWS else (
        f'{source} The {TABLE_ROWS} worst of {len(found)}.')
    return Table('Stretches above the limit' if rows else 'No section is above a limit',
                 ('rail', 'from - to [m]', 'length [m]', 'wavelengths', 'worst RMS [µm]',
                  'limit [µm]', 'ratio', 'dominant wavelength [mm]') if rows else (),
                 rows, remark)


def _card(title: str, *parts: str) -> str:
    return f'<section class="card"><h2>{escape(title)}</h2>{"".join(parts)}</section>'


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>' if text else ''


def _tile(tile: Tile) -> str:
    return (f'<div class="tile"><div class="label">{escape(tile.label)}</div>'
            f'<div class="value">{escape(tile.value)}</div>'
            f'<div class="remark">{escape(tile.remark)}</div></div>')


def _table(table: Table) -> str:
    head = ''.join(f'<th>{escape(c)}</th>' for c in table.columns)
    body = ''.join('<tr>' + ''.join(f'<td>{escape(c)}</td>' for c in row) + '</tr>'
                   for row in table.rows)
    return (f'<h3>{escape(table.title)}</h3>{_note(table.remark)}<div class="scroll"><table>'
            f'<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>')


def _box_choice(report: Report) -> str:
    plots_with_boxes = [p for p in (report.irregularity, *report.waveforms) if p is not None]
    boxes = dict.fromkeys(b for p in plots_with_boxes for b in p.axle_boxes)
    boxes |= dict.fromkeys(report.spectra)
    if len(boxes) < 2:
        return ''
    options = ''.join(
        f'<option value="{escape(b)}"{" selected" if b == report.axle_box else ""}>'
        f'{escape(style.box_title(b))}</option>' for b in boxes)
    return f'<label class="choice">axle box <select id="axle-box">{options}</select></label>'


def _asset(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding='utf-8')


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none';
 script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="railtrack_ros {version}">
<title>{title}</title>
<style>
{styles}
</style>
</head>
<body>
<header><div class="inner"><div class="brand">railtrack</div><h1>{title}</h1>
<p class="subtitle">{subtitle}</p></div></header>
<main>
<section class="card lead"><h2>What was found</h2><ul>{findings}</ul>
<div class="tiles">{tiles}</div></section>
{boxes}
{body}
<noscript><p class="card">The plots need JavaScript; the tables and figures above do not.</p>
</noscript>
</main>
<footer>railtrack_ros {version}. Irregularity is the combined, contact-filtered one of wheel and
rail, measured indirectly.</footer>
<script>{plotly}</script>
<script>
{script}
</script>
</body>
</html>
"""
