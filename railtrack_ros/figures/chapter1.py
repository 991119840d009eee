"""Figure 1.3: the track's three resonances and the shapes that go with them."""

from __future__ import annotations

import numpy as np

from railtrack_ros.dynamics.receptance import receptance, receptances
from railtrack_ros.dynamics.resonances import track_resonances
from railtrack_ros.figures.cases import table_3_1
from railtrack_ros.figures.content import AGREES, UNKNOWN, Array, Curve, Figure, Finding, Panel
from railtrack_ros.track.description import Track
from railtrack_ros.track.infinite import Sleeper

NEIGHBOURS = 3  # bays on either side in the deflection shapes


def figure_1_3() -> Figure:
    """Point receptance at mid-span and above a sleeper, with the three deflection shapes."""
    track = table_3_1('DS')
    spacing = track.support.spacing
    frequency = np.geomspace(20.0, 2500.0, 1200)
    midspan, sleeper = (np.abs(receptance(track, frequency, x)) for x in (0.5 * spacing, 0.0))
    named = {found.name: found.frequency for found in track_resonances(track)
             if found.place == 'midspan'}
    f1, f2, f3 = (named[name] for name in ('in-phase', 'out-of-phase', 'pinned-pinned'))
    panels = [Panel(
        'frequency_hz', 'Frequency (Hz)', 'Receptance (m/N)', frequency,
        (Curve('midspan_m_per_n', 'Mid-span excitation', midspan),
         Curve('sleeper_m_per_n', 'Excitation above a sleeper', sleeper, '--')),
        logarithmic=True)]
    x = np.linspace(-NEIGHBOURS, NEIGHBOURS, 241)
    for number, f in enumerate((f1, f2, f3), start=1):
        panels.append(_shape(track, f, x, number))
    there = np.interp(f3, frequency, sleeper) / np.interp(f3, frequency, midspan)
    return Figure(
        'Table 3.1, distributed supports, rail without loss, exact infinite track. The thesis '
        'draws the shapes by hand; here they are computed, at the instant of the largest '
        'deflection under a force at mid-span, rail and sleepers.',
        tuple(panels),
        (Finding('rail and sleepers in phase, between 50 and 300 Hz', f'{f1:.1f} Hz', AGREES),
         Finding('rail against sleepers, between about 200 and 600 Hz', f'{f2:.1f} Hz', AGREES),
         Finding('pinned-pinned, around 1000 Hz; largest at mid-span, least above a sleeper',
                 f'{f3:.1f} Hz, above the sleeper {100.0 * there:.0f} % of mid-span', AGREES),
         Finding('parameters of the figure', 'those of table 3.1 assumed', UNKNOWN)),
        columns=2)


def _shape(track: Track, frequency: float, x: Array, number: int) -> Panel:
    """Deflection of rail and sleepers at one frequency, force at x = 0 (mid-span)."""
    spacing = track.support.spacing
    places = (0.5 + x) * spacing
    rail = receptances(track, [frequency], list(places), 0.5 * spacing)[:, 0]
    count = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
    answers = [Sleeper(int(k)) for k in count]
    sleepers = receptances(track, [frequency], answers, 0.5 * spacing)[:, 0]
    turn = np.exp(-1j * np.angle(rail[np.argmax(np.abs(rail))]))
    scale = np.abs(rail).max()
    at_sleepers = np.full(x.size, np.nan)
    for k, value in zip(count, sleepers, strict=True):
        nearest = int(np.argmin(np.abs(x - (k - 0.5))))
        if abs(x[nearest] - (k - 0.5)) < 1e-9:
            at_sleepers[nearest] = (value * turn).real / scale
    return Panel(
        'distance_in_bays', 'Distance from the force (sleeper spacings)', 'Deflection (-)', x,
        (Curve('rail', 'rail', (rail * turn).real / scale),
         Curve('sleeper', 'sleepers', at_sleepers, 's')),
        title=f'{number}: {frequency:.0f} Hz', name=f'shape_{number}', y_limits=(-1.1, 1.1))
