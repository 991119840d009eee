"""The report: what it shows, what it leaves out, and that it opens without any network."""

import dataclasses
import html.parser
import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from railtrack_ros import __version__
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.report import plots, sections
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
from railtrack_ros.report.overview import draw_overview
from railtrack_ros.report.page import render, write_report
from railtrack_ros.runs.estimate_report import write_estimate_report
from railtrack_ros.runs.estimated import BoxFigures, Estimated
from railtrack_ros.vehicle.description import load_vehicle

BOXES = ('axle1_left', 'axle2_left', 'axle1_right', 'axle2_right')
CHROMIUM = next(filter(None, map(shutil.which, (
    'chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable'))), None)
LIMITS = {'rms_10_30_um': 3.0, 'rms_30_100_um': 7.0, 'rms_100_300_um': 7.0}


def indicator_rows(corrugated=(150, 200), rails=('left', 'right'), amplitude=25.0):
    rows = []
    for box in BOXES:
        rail = box.split('_')[1]
        for start in range(100, 300, 10):
            bad = corrugated[0] <= start < corrugated[1] and rail in rails
            rows.append({
                'axle_box': box, 'rail': rail, 'from_m': float(start), 'to_m': start + 10.0,
                'speed_m_s': 25.0, 'rms_10_30_um': '', 'rms_100_300_um': 3.0,
                'rms_30_100_um': amplitude if bad else 2.0,
                'dominant_wavelength_m': 0.05 if bad else '',
            })
    return rows


def waveform_plot(title, quantity, roles, scale=1e6, unit='µm', n=500):
    x = np.arange(n) * 2e-3
    waves = {role: 1e-5 * np.sin(2 * np.pi * x / 0.05 + i) for i, role in enumerate(roles)}
    return WaveformPlot(title, quantity, unit, scale,
                        {box: Waveform(150.0, 2e-3, waves) for box in BOXES})


@pytest.fixture
def full_report():
    wavelength = 10.0 ** (-np.arange(20) / 10)
    frequency = 10.0 ** (np.arange(13, 34) / 10)
    level = np.linspace(20, -10, 20)
    spectrum = Spectrum(wavelength, {'limit': level - 1, 'truth': level, 'estimated': level + 0.3})
    rng = np.random.default_rng(1)
    return Report(
        title='Replay of <run> & more', subtitle='run.mcap, mainline_soft_pads',
        findings=['Both rails are corrugated between 150 m and 200 m.'],
        tiles=[Tile('contact force error', '0.31 dB', 'worst one-third octave')],
        indicators=Indicators(indicator_rows(), LIMITS, 'Limits of somebody.'),
        irregularity=waveform_plot('Irregularity', 'irregularity', ('truth', 'estimated')),
        spectra=dict.fromkeys(BOXES, spectrum),
        waveforms=[waveform_plot('Contact force', 'contact force',
                                 ('truth', 'full_model', 'estimated'), 1e-3, 'kN')],
        errors=[ErrorPlot('Contact force', {'full model - estimated': {
            box: BandError(frequency, 25 / frequency, rng.normal(0, 0.2, 21)) for box in BOXES}})],
        tables=[Table('RMS', ('axle box', 'kN'), [[box, '3.62'] for box in BOXES])],
        latency=Latency(np.arange(500) * 0.01, 4e-3 + 1e-4 * rng.random(500), 'As recorded.', 0.01),
        parameters={'track': {'name': 'mainline_soft_pads'}}, methods=['High-pass of order 4.'],
        highlight=(140.0, 160.0),
    )


def figures(page):
    """Return the plots of a page as they are handed to the plotting library."""
    sources = re.findall(r'<script type="application/json" class="figure"[^>]*>(.*?)</script>',
                         page, re.DOTALL)
    return [json.loads(source.replace('<\\/', '</')) for source in sources]


class Headings(html.parser.HTMLParser):
    def __init__(self):
        super().__init__()
        self.inside, self.found = None, []

    def handle_starttag(self, tag, attributes):
        self.inside = tag if tag in ('h1', 'h2', 'h3') else None

    def handle_endtag(self, tag):
        self.inside = None

    def handle_data(self, data):
        if self.inside:
            self.found.append(data)


def headings(page):
    parser = Headings()
    parser.feed(page)
    return parser.found


def without_library(page):
    """Return the page without the inlined source of the plotting library."""
    start = page.index('<script>/**')
    return page[:start] + page[page.index('</script>', start):]


def test_every_part_of_a_full_report_is_there(full_report):
    page = render(full_report)
    assert {'Corrugation by axle box, as told live', 'Irregularity',
            'Spectrum in one-third octaves', 'Contact force', 'How well they agree',
            'Live latency', 'How it was computed',
            'Stretches above the limit'} <= set(headings(page))
    assert len(figures(page)) == 7
    for text in ('0.31 dB', 'mainline_soft_pads', 'High-pass of order 4.', 'Limits of somebody.'):
        assert text in page


def test_text_is_escaped(full_report):
    page = render(full_report)
    assert 'Replay of &lt;run&gt; &amp; more' in page
    assert '<run>' not in page
    assert headings(page)[0] == 'Replay of <run> & more'


def test_a_measured_run_has_no_parts_about_truth_latency_or_limits(full_report):
    measured = dataclasses.replace(
        full_report, latency=None, indicators=None, highlight=None,
        irregularity=waveform_plot('Irregularity', 'irregularity', ('estimated',)),
        spectra={'axle1_left': Spectrum(np.array([1.0, 0.5]), {'estimated': np.array([1.0, 2.0])})},
        waveforms=[waveform_plot('Contact force', 'contact force', ('full_model', 'estimated'))])
    page = render(measured)
    assert not {'Live latency', 'Corrugation by axle box, as told live'} & set(headings(page))
    names = {trace['name'] for figure in figures(page) for trace in figure['data']}
    assert 'estimated' in names
    assert 'true' not in names


def test_nothing_is_fetched_from_a_network(full_report):
    page = without_library(render(full_report))
    assert re.findall(r'(?:https?:)?//[a-z0-9.-]+\.[a-z]+', page) == []
    assert not re.search(r'<(?:link|img|iframe)|@import|url\(', page)
    assert re.findall(r'<script[^>]*\bsrc=', page) == []


def test_every_plot_has_axis_titles_with_units(full_report):
    for figure in figures(render(full_report)):
        layout = figure['layout']
        axes = [value for key, value in layout.items() if re.match(r'[xy]axis\d*$', key)]
        titles = [axis['title'].get('text') for axis in axes]
        assert any(title and 'position' in title or title and re.search(r'\[.+\]|blocks', title)
                   for title in titles)
        assert layout.get('title') is None


def test_a_page_with_every_curve_of_eight_axle_boxes_stays_below_10_megabytes(full_report):
    boxes = [f'axle{i}_{side}' for side in ('left', 'right') for i in range(1, 5)]
    def plot(title, roles):
        wave = Waveform(0.0, 1e-3, {role: np.random.default_rng(0).random(5400) for role in roles})
        return WaveformPlot(title, title, 'kN', 1.0, dict.fromkeys(boxes, wave))
    three = ('truth', 'full_model', 'estimated')
    page = render(dataclasses.replace(
        full_report, irregularity=plot('irregularity', ('truth', 'estimated')),
        waveforms=[plot('force', three), plot('deflection', three),
                   plot('acceleration', ('measured', 'full_model'))]))
    assert len(page.encode()) < 10e6


def test_one_axle_box_is_shown_at_a_time_and_all_can_be_chosen(full_report):
    page = render(full_report)
    force = figures(page)[4]
    visible = {trace['meta']['axle_box'] for trace in force['data'] if trace['visible']}
    assert visible == {BOXES[0]}
    assert re.findall(r'<option value="(\w+)"', page) == list(BOXES)
    other = render(dataclasses.replace(full_report, axle_box='axle2_left'))
    assert re.findall(r'<option value="(\w+)" selected', other) == ['axle2_left']


def test_neighbouring_sections_above_a_limit_are_one_stretch():
    data = Indicators(indicator_rows(corrugated=(150, 200), rails=('left',)), LIMITS)
    stretch, = sections.exceedances(data)
    assert (stretch.rail, stretch.band) == ('left', 'rms_30_100_um')
    assert (stretch.start, stretch.end) == (150.0, 200.0)
    assert stretch.worst == pytest.approx(25.0)
    assert stretch.wavelength == pytest.approx(0.05)


def test_sections_apart_are_two_stretches_and_the_worst_comes_first():
    rows = [row for row in indicator_rows(rails=('left',)) if row['from_m'] not in (160.0, 170.0)]
    for row in rows:
        if row['from_m'] == 180.0 and row['rail'] == 'left':
            row['rms_30_100_um'] = 60.0
    first, second = sections.exceedances(Indicators(rows, LIMITS))
    assert (first.start, first.end) == (180.0, 200.0)
    assert (second.start, second.end) == (150.0, 160.0)


def test_a_section_that_is_not_resolved_is_never_above_a_limit():
    rows = [{**row, 'rms_30_100_um': ''} for row in indicator_rows()]
    data = Indicators(rows, LIMITS)
    assert sections.exceedances(data) == []
    assert np.isnan(sections.along_rail(data, 'left', 'rms_30_100_um').mean).all()
    figure = plots.strip_chart(data)
    assert any('not resolved' in note.text for note in figure.layout.annotations)


def test_axle_boxes_of_a_rail_are_averaged_by_energy():
    rows = [{'axle_box': box, 'rail': 'left', 'from_m': 0.0, 'to_m': 10.0, 'rms_30_100_um': value}
            for box, value in (('a', 3.0), ('b', 4.0))]
    found = sections.along_rail(Indicators(rows, {}), 'left', 'rms_30_100_um')
    assert found.mean == pytest.approx([np.sqrt((9 + 16) / 2)])
    assert (found.low, found.high) == ([3.0], [4.0])


def test_an_interrupted_report_leaves_the_old_one(full_report, tmp_path, monkeypatch):
    path = tmp_path / 'report.html'
    path.write_text('old')

    def interrupted(report):
        raise KeyboardInterrupt
    monkeypatch.setattr('railtrack_ros.report.page.render', interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_report(path, full_report)
    assert path.read_text() == 'old'
    assert list(tmp_path.iterdir()) == [path]


def test_the_overview_picture_is_drawn(full_report, tmp_path):
    path = draw_overview(tmp_path / 'overview.png', full_report, dots_per_inch=40)
    from matplotlib.image import imread
    pixels = imread(path)[..., :3]
    assert pixels.shape[1] > 300
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


def test_an_overview_without_force_is_refused(full_report, tmp_path):
    with pytest.raises(InputError, match='contact force'):
        draw_overview(tmp_path / 'x.png', dataclasses.replace(full_report, waveforms=[]))


@pytest.fixture
def browser(tmp_path):
    if CHROMIUM is None:
        pytest.skip('no Chromium')

    def run(path, *options):
        return subprocess.run([
            CHROMIUM, '--headless', '--no-sandbox', '--disable-gpu', '--disable-quic',
            '--no-first-run', '--disable-background-networking', '--disable-component-update',
            '--disable-sync', '--disable-dev-shm-usage',
            f'--user-data-dir={tmp_path / "profile"}', '--virtual-time-budget=10000',
            '--host-resolver-rules=MAP * ~NOTFOUND', *options,
            path.as_uri()], capture_output=True, text=True, timeout=120)
    return run


def test_a_browser_draws_every_plot_and_asks_no_network(full_report, browser, tmp_path):
    log = tmp_path / 'net.json'
    full_report = dataclasses.replace(full_report, axle_box='axle1_right')
    path = write_report(tmp_path / 'report.html', full_report)
    document = browser(path, '--dump-dom', f'--log-net-log={log}').stdout
    body = document[document.index('<body'):]
    drawn = re.findall(r'<div class="plot js-plotly-plot"', body)
    assert len(drawn) == 7
    assert body.count('class="main-svg"') >= 7
    assert len(re.findall(r'<path class="js-line"', body)) > 10
    assert 'NaN' not in ''.join(re.findall(r' d="([^"]*)"', body))
    hosts = set(re.findall(r'"url":"(?:https?|wss?)://([^/:"]+)', log.read_text()))
    assert {h for h in hosts if not re.search(r'(^|\.)(google|googleapis)\.com$', h)} == set(), (
        'beside those that the browser itself asks')


def test_the_page_of_an_estimate_tells_what_it_was_computed_with(table_3_1, tmp_path):
    coach = load_vehicle('measurement_coach')
    found = Estimated(EstimatorSettings(), sample_rate=25600.0, duration=10.0, distance=300.0,
                      start=0.0, end=300.0, lowest_speed=29.0, highest_speed=31.0,
                      boxes={'axle1_left': BoxFigures(1000, 980, 30e3, 90e3)},
                      defects=['run.mcap: lead: 3 of 100 samples are no number'],
                      remarks=['run.mcap: gap of 0.05 s'])
    path = tmp_path / 'estimate.html'
    report = write_estimate_report(path, 'run.mcap', found, table_3_1, coach, IndicatorSettings(),
                                   tmp_path / 'estimate.mcap')
    page = path.read_text()
    for text in ('recording has defects: run.mcap: lead: 3 of', 'In the recording: run.mcap: gap',
                 'cut on wavelength', '3.0 m', __version__, '25600 Hz',
                 'Butterworth', 'distributed, every 0.6 m', '98.0', 'minimum prominence'):
        assert text in page, text
    assert report.title == 'Estimate of run.mcap'
    assert 'http://' not in page.split('<script>')[0]


def test_values_per_section_are_shown_along_all_of_the_track():
    wave = Waveform(5.0, 10.0, {'first': np.ones(30), 'second': np.ones(30)})
    figure = plots.waveforms(WaveformPlot('a', 'RMS', 'µm', 1.0, {'axle1_left': wave}))
    assert figure.layout.xaxis.range is None
    assert not figure.layout.xaxis.rangeslider.visible
    fine = Waveform(5.0, 0.01, {'first': np.ones(3000)})
    figure = plots.waveforms(WaveformPlot('a', 'force', 'kN', 1.0, {'axle1_left': fine}))
    assert np.ptp(figure.layout.xaxis.range) == 3.0
