"""The page that holds figures and evidence against the thesis."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from railtrack_ros import __version__
from railtrack_ros.dynamics.decay_rate import NOMINAL
from railtrack_ros.errors import InputError
from railtrack_ros.figures import evidence, evidence_time
from railtrack_ros.figures.content import AGREES, DIFFERS, Array, Entry, Figure
from railtrack_ros.figures.evidence import Section, table
from railtrack_ros.output import replacing

SECTIONS = (
    evidence.misprints, evidence.exact_track, evidence.closed_forms,
    evidence_time.moving_load, evidence_time.mesh_in_time, evidence_time.time_step,
    evidence_time.energy, evidence_time.solvers, evidence_time.there_and_back,
    evidence_time.measured_vibration,
)
DECAY_RATES = 'measured_decay_rates.md'  # beside the page in the documentation
INTRODUCTION = (
    'Every figure of B. Blanco, *Railway track dynamic modelling* (licentiate thesis, KTH '
    'Stockholm 2017, TRITA-AVE 2017:34), computed again by the public functions of this program, '
    'in the axes and units of the thesis; then evidence that does not come from the thesis. '
    'Nothing on this page is written by hand: `railtrack figures --output DIR` makes it and the '
    'data of every figure as CSV.\n\n'
    'What the thesis shows is judged by what its text and the axes of its figures tell. Its '
    'curves were not digitised.')


def write_page(path: Path, pictures: Path, made: Sequence[tuple[Entry, Figure]],
               sections: Sequence[Section]) -> None:
    """Write the page to `path`; the pictures lie in the folder `pictures`.  Raises InputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{path}: cannot be written: {(error.strerror or "").lower()}') from error
    text = page(os.path.relpath(pictures, path.parent), made, sections,
                (path.parent / DECAY_RATES).is_file())
    with replacing(path) as part:
        part.write_text(text, encoding='utf-8')


def decay_section(measured: Array | None = None, rate: Array | None = None,
                  values: Mapping[str, float] | None = None) -> Section:
    """Return measured decay rates against the model's.

    measured (measurements, 18) and rate (18,) [dB/m] in the one-third octaves of
    dynamics.decay_rate, values: what was fitted; nothing where there are no measurements.
    """
    title = 'Measured decay rates'
    if measured is None or rate is None or values is None:
        return Section(title, 'Not computed: the environment variable RAILTRACK_DATA does not name '
                       'a folder with the measurements.')
    mean = 10.0 ** np.log10(measured).mean(axis=0)
    fitted = NOMINAL <= 3150.0

    def rms(levels: Array) -> str:
        return f'{float(np.sqrt(np.mean((10.0 * levels) ** 2))):.1f} dB'

    inside = (rate >= measured.min(axis=0)) & (rate <= measured.max(axis=0))
    rows = [[f'{f:g}', f'{m:.1f}', f'{low:.1f} to {high:.1f}', f'{r:.1f}',
             f'{10.0 * np.log10(r / m):+.1f}'] for f, m, low, high, r in
            zip(NOMINAL, mean, measured.min(axis=0), measured.max(axis=0), rate, strict=True)]
    return Section(title, '\n\n'.join((
        f'{len(measured)} measurements after EN 15461 near Niederwangen (hard pads, no dampers; '
        'repository mic-haf/SDWirkungNi, CC0 1.0) against the exact infinite track with a UIC60 '
        'rail and distributed supports, of which five values were fitted inside plausible ranges: '
        + ', '.join(f'{name.replace("_", " ")} {value:.3g}' for name, value in values.items())
        + ' (SI). RMS of the level difference from 100 to 3150 Hz: model '
        f'{rms(np.log10(rate / mean)[fitted])}, single measurements from their mean '
        f'{rms(np.log10(measured / mean)[:, fitted])}; the model lies inside their spread in '
        f'{int(inside[fitted].sum())} of {int(fitted.sum())} bands.',
        table(('band [Hz]', 'mean [dB/m]', 'spread [dB/m]', 'model [dB/m]', 'difference [dB]'),
              rows))),
        f'model within {rms(np.log10(rate / mean)[fitted])} RMS of the mean of '
        f'{len(measured)} measurements, which scatter by '
        f'{rms(np.log10(measured / mean)[:, fitted])}')


def page(pictures: str, made: Sequence[tuple[Entry, Figure]], sections: Sequence[Section],
         decay_rates: bool) -> str:
    """Return the page; `pictures` is the folder of the pictures as seen from it."""
    overview = [[f'[{entry.number}](#figure-{_anchor(entry.number)})', entry.title,
                 '; '.join(sorted({finding.verdict for finding in figure.findings}))]
                for entry, figure in made]
    digest = [f'- **[{section.title}](#{slug(section.title)})**: {section.digest}'
              for section in sections if section.digest]
    parts = ['# Validation', INTRODUCTION, '## In short', _outcome(made), '\n'.join(digest),
             '## Figures of the thesis', table(('figure', 'shows', 'outcome'), overview)]
    parts += [_figure(entry, figure, pictures) for entry, figure in made]
    for section in sections:
        parts += [f'## {section.title}', section.text]
    if decay_rates:
        parts.append('More about the measured decay rates, and where the model fails: '
                     f'[Against measured track decay rates]({DECAY_RATES}).')
    parts.append(f'Written by railtrack {__version__}.')
    return '\n\n'.join(parts) + '\n'


def _outcome(made: Sequence[tuple[Entry, Figure]]) -> str:
    """Count the outcomes of all findings."""
    verdicts = [finding.verdict for _, figure in made for finding in figure.findings]
    agreeing, differing = verdicts.count(AGREES), verdicts.count(DIFFERS)
    return (f'{len(made)} figures, {len(verdicts)} statements of the thesis: {agreeing} agree, '
            f'{differing} differ{"s" if differing == 1 else ""}, the others are misprinted, depend '
            'on the length of the track or on what the thesis does not say. Beyond the thesis:')


def slug(title: str) -> str:
    """Return the anchor of a heading."""
    return re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-')


def _figure(entry: Entry, figure: Figure, pictures: str) -> str:
    prefix = '' if pictures == '.' else f'{Path(pictures).as_posix()}/'
    rows = [[finding.thesis, finding.computed, finding.verdict] for finding in figure.findings]
    return '\n\n'.join((
        f'### Figure {entry.number}', f'{entry.title}. {figure.conditions}',
        f'![{entry.title}]({prefix}{entry.stem}.png)',
        table(('the thesis', 'computed here', 'outcome'), rows)))


def _anchor(number: str) -> str:
    return number.replace('.', '')


def speed_section(found: Mapping[str, float], processor: str) -> Section:
    """Return the measured claim of speed; `found`: microseconds a step by name."""
    static, dynamic = 'static local system', 'dynamic local system'

    def row(label: str, key: str) -> list[str]:
        return [label, *(_short(found[f'{key}, {local}']) for local in (static, dynamic))]

    def ratio(slow: str, fast: str) -> float:
        return found[slow] / found[fast]

    convolution = f'convolution (4.4), {static}'
    plain = {local: ratio(f'plain direct integration, {local}', convolution)
             for local in (static, dynamic)}
    return Section('The claim of speed', '\n\n'.join((
        'The thesis: without precalculation the convolution (static local system) is one order of '
        'magnitude faster than direct integration with the dynamic, two orders faster than with '
        'the static local system. Measured for the two cases of figure 4.3, 61 bays (62 in the '
        'full model), one thread, steps of 25 us, processor time, the best of repeats, in '
        'microseconds a step '
        f'({processor}):',
        table(('', static + ', 6 elements a bay', dynamic + ', 4 elements a bay'), (
            row('direct integration as (2.26) to (2.31) have it: matrices assembled and factorised '
                'in every iteration',
                'plain direct integration'),
            row('direct integration, `--solver newmark`', 'full model'),
            row('convolution, `--solver irf`', 'convolution (4.4)'),
            row('convolution as a recursion, `--solver recursive`', 'recursion'))),
        f'Against that plain implementation the convolution is {_short(plain[dynamic])} times '
        f'(dynamic) and {_short(plain[static])} times (static) faster: '
        + ('the claim holds, and by more than it says. ' if plain[dynamic] > 10.0
           and plain[static] > 100.0 else 'that falls short of the claim here. ')
        + 'It is not a property of the method, though. With a matrix that is factorised once and '
        'contacts as rank-one corrections, the same direct integration takes '
        f'{_short(ratio(f"full model, {dynamic}", convolution))} (dynamic) and '
        f'{_short(ratio(f"full model, {static}", convolution))} (static) of the time of the '
        'convolution, and the convolution as a recursion over the modes of the track, on which '
        'the live estimator rests, '
        f'{_short(ratio(f"recursion, {static}", convolution))} of it. The thesis finds the dynamic '
        'local system cheaper than the static one, which needs more elements to be as continuous; '
        'at 4 and 6 elements a bay it costs more.')),
        f'convolution {_short(plain[dynamic])} and {_short(plain[static])} times faster than plain '
        'direct integration, but slower than one that factorises once')


def _short(value: float) -> str:
    return f'{float(f"{value:.2g}"):g}'
