"""Measured track decay rates against the model: fit of a plausible track, plot, differences.

The measurements (Niederwangen, Switzerland; concrete sleepers, hard rail pads, no rail dampers;
repository mic-haf/SDWirkungNi, CC0 1.0) are looked for where RAILTRACK_DATA says.  Prints the
tables of docs/measured_decay_rates.md and draws its picture:

    python benchmarks/measured_decay_rates.py [--plot docs/images/measured_decay_rates.png]
"""

import argparse
import csv
import dataclasses
import sys

import numpy as np
from scipy.optimize import least_squares

from railtrack_ros import paths
from railtrack_ros.dynamics.decay_rate import NOMINAL, track_decay_rate
from railtrack_ros.report.curves import draw_decay_rate
from railtrack_ros.track.description import Track, load_track

# What a hard-padded ballasted track can plausibly have (per rail, SI); the fit stays inside.
PLAUSIBLE = {
    'pad_stiffness': (200e6, 3000e6),
    'pad_damping': (5e3, 200e3),
    'ballast_stiffness': (20e6, 300e6),
    'ballast_damping': (20e3, 400e3),
    'loss_factor': (0.001, 0.05),
}
HIGHEST_FITTED = 3150.0  # [Hz]: above, web and foot of a real rail deform, which a beam does not


def measurements(folder) -> np.ndarray:
    """Vertical decay rates without dampers (measurements, 18) [dB/m]."""
    curves: dict[str, dict[float, float]] = {}
    with open(folder / 'niederwangen_track_decay_rate.csv', encoding='utf-8') as file:
        for row in csv.DictReader(file):
            if row['dir'] == 'v' and row['damp'] == 'False':
                curves.setdefault(row['tdr_id'], {})[float(row['freq'])] = float(row['tdr'])
    return np.array([[curve[f] for f in NOMINAL] for curve in curves.values()])


def plausible_track(values: dict[str, float], kind: str = 'distributed') -> Track:
    """UIC60 rail, sleepers of 300 kg every 0.6 m, and the given values."""
    base = load_track('blanco_table_3_1')
    support = {key: value for key, value in values.items() if key != 'loss_factor'}
    return Track(
        'niederwangen', dataclasses.replace(base.rail, loss_factor=values['loss_factor']),
        dataclasses.replace(base.support, kind=kind, spacing=0.6, pad_length=0.18,
                            sleeper_mass=150.0, **support))


def level_difference(rate: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """10 lg of the ratio of two decay rates [dB]."""
    return 10.0 * np.log10(rate / measured)


def fit(measured: np.ndarray) -> dict[str, float]:
    """Least squares of the level difference up to 3150 Hz over the plausible values."""
    names = list(PLAUSIBLE)
    low, high = np.log(np.array([PLAUSIBLE[name] for name in names])).T
    fitted = NOMINAL <= HIGHEST_FITTED

    def difference(logarithms: np.ndarray) -> np.ndarray:
        values = dict(zip(names, np.exp(logarithms), strict=True))
        rate = track_decay_rate(plausible_track(values)).rate
        return level_difference(rate, measured)[fitted]

    starts = [np.log([s, 40e3, 80e6, 80e3, 0.01]) for s in (500e6, 1200e6)]
    results = [least_squares(difference, x, bounds=(low, high), diff_step=1e-3, xtol=1e-5)
               for x in starts]
    best = min(results, key=lambda result: result.cost)
    return dict(zip(names, np.exp(best.x).tolist(), strict=True))


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def main() -> int:
    """Fit, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--plot', help='also draw the overlay to this file')
    args = parser.parse_args()
    folder = paths.reference_data()
    if folder is None:
        print('no reference data: set RAILTRACK_DATA to its folder', file=sys.stderr)
        return 2
    measured = measurements(folder)
    mean = 10.0 ** np.log10(measured).mean(axis=0)
    values = fit(mean)
    for name, value in values.items():
        low, high = PLAUSIBLE[name]
        at_limit = ' (at the end of the plausible range)' if not (
            1.01 * low < value < 0.99 * high) else ''
        print(f'{name:<18} {value:.4g}{at_limit}')
    rate = track_decay_rate(plausible_track(values)).rate
    print('band  measured  lowest  highest  model   difference')
    for f, m, low, high, r in zip(NOMINAL, mean, measured.min(axis=0), measured.max(axis=0), rate,
                                  strict=True):
        print(f'{f:5.0f} {m:8.2f} {low:8.2f} {high:8.2f} {r:7.2f} '
              f'{10.0 * np.log10(r / m):+7.1f} dB {r - m:+7.2f} dB/m')
    fitted = NOMINAL <= HIGHEST_FITTED
    for label, use in (('100 to 3150 Hz', fitted), ('100 to 5000 Hz', NOMINAL > 0.0)):
        difference = level_difference(rate, mean)[use]
        spread = level_difference(measured, mean)[:, use]
        inside = (rate >= measured.min(axis=0)) & (rate <= measured.max(axis=0))
        print(f'{label}: model against mean of {len(measured)} measurements {rms(difference):.2f} '
              f'dB RMS ({rms((rate - mean)[use]):.2f} dB/m), single measurements against their '
              f'mean {rms(spread):.2f} dB RMS; model inside the spread in '
              f'{int(inside[use].sum())} of {int(use.sum())} bands')
    if args.plot:
        draw_decay_rate(
            args.plot, NOMINAL, {'model, fitted up to 3150 Hz': rate, 'measured, mean': mean},
            band=(f'{len(measured)} measurements', measured.min(axis=0), measured.max(axis=0)),
            title='Vertical track decay rate, concrete sleepers, hard pads')
    return 0


if __name__ == '__main__':
    sys.exit(main())
