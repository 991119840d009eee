"""Figures 4.1 and 4.3: impulse responses and convolution."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from railtrack_ros.dynamics.modes import make_track_modes
from railtrack_ros.dynamics.receptance import receptance
from railtrack_ros.figures.cases import sleepers, steady_3_1, table_3_1, thinned
from railtrack_ros.figures.content import (
    AGREES,
    DIFFERS,
    MISPRINT,
    UNKNOWN,
    Array,
    Curve,
    Figure,
    Finding,
    Panel,
)
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.vehicle.description import load_vehicle

RING = 121  # bays: no wave comes round within 0.04 s
HIGHEST = 2500.0  # Hz, where the thesis cuts its receptance off
SPEEDS = (0.0, 30.0, 60.0)
MEMORY = 0.3  # s of the convolution: without loss the pinned-pinned wave lives long


def transformed(x: float, t: Array, highest: float = HIGHEST, step: float = 2.0) -> Array:
    """Impulse response (n,) [m/(N s)] by (4.2): inverse Fourier transform of the receptance.

    h(t) = (1/pi) Re integral of H e^{i omega t} from 0 to `highest` [Hz], trapezoidal in steps of
    `step` [Hz]; exact infinite track of table 3.1 on concentrated supports, loss factor 0.02.
    """
    f = np.arange(step, highest + 0.5 * step, step)
    h = receptance(table_3_1('CVS', 0.02), f, x)
    weight = np.ones(f.size)
    weight[-1] = 0.5
    static = 0.5 * abs(h[0])
    phase = np.exp(2j * math.pi * np.outer(t, f))
    result: Array = 2.0 * step * ((phase * (weight * h)).sum(axis=1).real + static)
    return result


def _irf(x: float, axis: tuple[float, float]) -> Figure:
    """Static and moving impulse responses for an impulse at x; axis: extreme ticks printed."""
    bay = make_bay(table_3_1('CVS', 0.02), Mesh(8, local_system='dynamic'))
    modes = make_track_modes(bay, RING, 10e3)
    t = np.arange(1e-4, 0.04, 2.5e-5)
    moving = {v: modes.impulse_response(t, x + v * t, x) for v in SPEEDS}
    curves = tuple(
        Curve('static_m_per_ns' if v == 0.0 else f'moving_{v:.0f}_m_s_m_per_ns',
              'Static' if v == 0.0 else f'{v:.0f} m/s', values, line)
        for (v, values), line in zip(moving.items(), ('-', '--', '-.'), strict=True))
    rail = table_3_1().rail
    jump = 0.5 / math.sqrt(rail.shear_stiffness * rail.mass_per_length)
    cut = transformed(x, np.linspace(0.0, 0.04, 1601))
    later = t > 2e-3
    by_transform = transformed(x, t[later])
    apart = np.std(by_transform - moving[0.0][later]) / np.std(moving[0.0][later])
    differ = np.abs(moving[60.0][later] - moving[0.0][later]).max() / np.abs(
        moving[0.0][later]).max()
    low, high = float(cut.min()), float(cut.max())
    fits = 0.5 * low > 1.2 * axis[0] and 0.5 * high < 1.1 * axis[1]
    return Figure(
        'Table 3.1, concentrated supports, loss factor 0.02, poles up to 10 kHz of a ring of '
        f'{RING} bays; response under a point that leaves the place of the impulse at t = 0 '
        '(d0 = 0). The axis is twice that of the thesis, see below.',
        (Panel('time_s', 'Time (s)', 'Response (m/Ns)', t, curves, x_limits=(0.0, 0.04),
               y_limits=(2.4 * axis[0], 2.4 * axis[1])),),
        (Finding(f'extreme ticks {axis[0]:.1e} and {axis[1]:.1e}, unit m/N',
                 f'band-limited to 2500 Hz as there, the response runs from {low:.2e} to '
                 f'{high:.2e} m/(N s), '
                 + ('half of which fits the axis: ' if fits else 'half of its minimum fits the '
                    'axis, the first peak would still pass it: ')
                 + '(4.2) sums positive frequencies only, without the factor two that stands '
                 'for the negative ones', MISPRINT),
         Finding('found by an inverse Fourier transform up to 2500 Hz',
                 f'with the factor two it agrees with the poles within {100.0 * apart:.1f} % RMS '
                 f'after 2 ms. At t = 0 it gives {cut[0]:.2e}, where a Timoshenko beam jumps to '
                 f'1/(2 sqrt(kAG rhoA)) = {jump:.3e} m/(N s): a transform returns at most half '
                 'of a jump', AGREES),
         Finding('static and moving responses drift apart with time and speed',
                 f'at 60 m/s by up to {100.0 * differ:.0f} % of the largest response after 2 ms',
                 AGREES)))


def figure_4_1a() -> Figure:
    """Impulse response above a sleeper."""
    return _irf(0.0, (-5e-7, 20e-7))


def figure_4_1b() -> Figure:
    """Impulse response at mid-span."""
    return _irf(0.3, (-1e-6, 2e-6))


def figure_4_3() -> Figure:
    """Contact force by convolution and by direct integration."""
    load = load_vehicle('blanco_table_3_1').wheel.static_load
    cases = {'static': (Mesh(6), 'newmark'), 'convolution': (Mesh(6), 'irf'),
             'dynamic': (Mesh(4, local_system='dynamic'), 'newmark')}
    found = {}
    for name, (mesh, solver) in cases.items():
        options: dict[str, Any] = {'memory': MEMORY} if solver == 'irf' else {}
        x, result = steady_3_1('CVS', mesh, solver=solver, time_step=25e-6, **options)
        x, found[name] = thinned(x, result.contact_force[:, 0] / load)
    ripple = np.std(found['dynamic'])
    apart = np.std(found['convolution'] - found['static']) / np.std(found['static'])
    other = np.std(found['convolution'] - found['dynamic']) / ripple
    labels = {'static': ('Static approach', '-'), 'convolution': ('Convolution', '--'),
              'dynamic': ('Dynamic approach', '-.')}
    return Figure(
        'Table 3.1, concentrated supports, 24 m/s, rail without loss, steps of 25 us, memory '
        f'{MEMORY:g} s. Static and convolution: 6 elements a bay; dynamic: 4 elements.',
        (Panel('distance_m', 'Distance (m)', 'Contact force factor (-)', x,
               tuple(Curve(name, label[0], found[name], label[1])
                     for name, label in labels.items()),
               x_limits=(6.0, 9.0), y_limits=(0.9, 1.05), supports=sleepers(0.6, 6.0, 9.0)),),
        (Finding('convolution agrees with direct integration, static local system',
                 f'RMS of the difference {100.0 * apart:.2f} % of the dynamic force (what the '
                 'memory and the ends of the tracks leave, the rail being without loss)',
                 AGREES if apart < 0.05 else DIFFERS),
         Finding('and with the dynamic one up to its jumps at nodes',
                 f'{100.0 * other:.1f} %', AGREES if other < 0.2 else DIFFERS),
         Finding('figure 4.2 (Mazilu): axis 90 to 105 kN; the curve cannot be read from the text',
                 f'{load / 1e3 * found["dynamic"].min():.2f} to '
                 f'{load / 1e3 * found["dynamic"].max():.2f} kN', UNKNOWN)))
