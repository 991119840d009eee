"""Cost and accuracy of the online solver: the figures and plots of docs/online_solver.md.

    python benchmarks/online_accuracy.py docs/images
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from measuring import best_time
from scipy import signal

from railtrack_ros.dynamics.forward import ForwardResult
from railtrack_ros.dynamics.irf import IrfForward
from railtrack_ros.dynamics.modes import make_track_modes, ring_length
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import MAXIMUM_FREQUENCY, RecursiveForward
from railtrack_ros.estimation.closed_loop import BANDS
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import AxleBox, load_vehicle

matplotlib.use('Agg')
import matplotlib.pyplot as plt  # noqa: E402

TRACK, VEHICLE = load_track('blanco_table_3_1'), load_vehicle('blanco_table_3_1')
STEP = 25e-6
BOGIES = (0.0, -2.5, -9.0, -11.5)
ROUGHNESS = iso3095(120.0, seed=3, start=-14.0)
SECOND = 10**9


def bay_of(kind: str, mesh: Mesh | None = None) -> Bay:
    support = dataclasses.replace(TRACK.support, kind=kind)
    return make_bay(dataclasses.replace(TRACK, support=support), mesh)


def run(speeds: tuple[float, float], step: float, duration: float, offsets: Sequence[float],
        rough: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n,) and irregularity (n, wheels)."""
    t = step * np.arange(round(duration / step))
    position = speeds[0] * t + 0.5 * (speeds[1] - speeds[0]) * t**2 / duration
    if rough:
        return position, ROUGHNESS.at(position[:, None] + np.asarray(offsets))
    return position, np.zeros((t.size, len(offsets)))


def errors(found: ForwardResult, reference: ForwardResult, step: float = STEP
           ) -> tuple[float, float, float]:
    """Percent: force, force below 5 kHz (of the dynamic force), deflection (of its rms)."""
    settled = slice(len(found.contact_force) // 5, None)
    low = signal.butter(8, 5000.0, fs=1.0 / step, output='sos')
    truth = reference.contact_force[settled]
    difference = found.contact_force[settled] - truth
    deflection = found.rail_deflection[settled] - reference.rail_deflection[settled]
    return (100.0 * float(np.sqrt(np.mean(difference**2)) / np.std(truth)),
            100.0 * float(np.std(signal.sosfiltfilt(low, difference, axis=0)) / np.std(truth)),
            100.0 * float(np.sqrt(np.mean(deflection**2)
                                  / np.mean(reference.rail_deflection[settled]**2))))


def cost(solver: Any, speed: float, step: float, offsets: Sequence[float]) -> float:
    """Microseconds a step, on rough rail."""
    position, irregularity = run((speed, speed), step, 22 * 300 * step, offsets, True)
    solver.run(position[:10], irregularity[:10])
    parts = iter(range(10, position.size - 300, 300))

    def part() -> None:
        begin = next(parts)
        solver.run(position[begin:begin + 300], irregularity[begin:begin + 300])

    return 1e6 * best_time(part, 20) / 300


def forward_table() -> None:
    """The sixteen cases of the forward solver against the full model of the same mesh."""
    print('| support | wheels | speed m/s | rail | force % | below 5 kHz % | deflection % |')
    print('| --- | --- | --- | --- | --- | --- | --- |')
    for kind in ('concentrated', 'distributed'):
        bay = bay_of(kind)
        for offsets in ((0.0,), BOGIES):
            for speeds in ((40.0, 40.0), (10.0, 40.0)):
                for rough in (False, True):
                    x, r = run(speeds, STEP, 0.5, offsets, rough)
                    reference = FullModel(bay, VEHICLE, offsets, STEP, 0.0, margin=90).run(x, r)
                    found = RecursiveForward(bay, VEHICLE, offsets, STEP, 0.0).run(x, r)
                    force, low, deflection = errors(found, reference)
                    print(f'| {kind} | {len(offsets)} | '
                          f'{"40" if speeds[0] == 40.0 else "10 to 40"} | '
                          f'{"rough" if rough else "smooth"} | {force:.2f} | {low:.3f} | '
                          f'{deflection:.4f} |', flush=True)


def ring_and_poles(folder: Path) -> None:
    """Bays and poles of the recursion, memory of the convolution."""
    bay = bay_of('distributed')
    x, r = run((40.0, 40.0), STEP, 0.4, (0.0,), True)
    reference = FullModel(bay, VEHICLE, (0.0,), STEP, 0.0, margin=90).run(x, r)
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout='constrained')

    def panel(axis: Any, label: str, values: Sequence[float], solvers: Sequence[Any],
              step: float, truth: ForwardResult, way: tuple[np.ndarray, np.ndarray],
              default: float) -> None:
        found = [errors(solver().run(*way), truth, step) for solver in solvers]
        times = [cost(solver(), 40.0, step, (0.0,)) for solver in solvers]
        for value, error, time in zip(values, found, times, strict=True):
            print(f'{label} {value:g}: force {error[0]:.3f} %, below 5 kHz {error[1]:.4f} %, '
                  f'deflection {error[2]:.4f} %, {time:.3g} us/step', flush=True)
        axis.semilogy(values, [e[0] for e in found], 'o-', label='force')
        axis.semilogy(values, [e[1] for e in found], 's-', label='force below 5 kHz')
        axis.semilogy(values, [e[2] for e in found], '^-', label='deflection')
        axis.axvline(default, color='0.7', zorder=0)
        axis.set(xlabel=label, ylabel='error, %')
        axis.grid(alpha=0.3)
        other = axis.twinx()
        other.plot(values, times, 'k:', label='cost')
        other.set(ylabel='cost (dotted), µs a step', ylim=(0.0, None))

    def recursive(bays: int, frequency: float) -> Any:
        modes = make_track_modes(bay, bays, frequency)
        return lambda: RecursiveForward(modes, VEHICLE, (0.0,), STEP, 0.0)

    own = ring_length(bay, [0.0])
    bays = [11, 15, 21, 31, 41, 61, 81]
    panel(axes[0], 'bays in the ring', bays, [recursive(n, MAXIMUM_FREQUENCY) for n in bays], STEP,
          reference, (x, r), own)
    hertz = [2000.0, 3000.0, 4500.0, 6000.0, 8000.0, 11000.0, 20000.0]
    panel(axes[1], 'poles kept up to, Hz', hertz, [recursive(own, f) for f in hertz], STEP,
          reference, (x, r), MAXIMUM_FREQUENCY)
    coarse = 5e-5
    x, r = run((40.0, 40.0), coarse, 0.3, (0.0,), True)
    reference = FullModel(bay, VEHICLE, (0.0,), coarse, 0.0, margin=90).run(x, r)
    memory = [0.0125, 0.025, 0.05, 0.1, 0.15]
    panel(axes[2], 'memory of the convolution, s', memory,
          [lambda s=s: IrfForward(bay, VEHICLE, (0.0,), coarse, 0.0, memory=s) for s in memory],
          coarse, reference, (x, r), 0.1)
    axes[0].legend()
    figure.savefig(folder / 'online_ring_poles_memory.png', dpi=90)


def error_by_frequency(folder: Path) -> None:
    """Coarse steps against the full model at 5 us."""
    bay, fine = bay_of('distributed'), 5e-6
    x, r = run((40.0, 40.0), fine, 0.5, (0.0,), True)
    truth = FullModel(bay, VEHICLE, (0.0,), fine, 0.0, margin=60).run(x, r).contact_force[:, 0]
    figure, axis = plt.subplots(figsize=(7, 4), layout='constrained')
    for label, step, kind, options in (
            ('exact exponentials, 50 µs', 5e-5, RecursiveForward, {'hold': 'linear'}),
            ('exact exponentials, 25 µs', 2.5e-5, RecursiveForward, {'hold': 'linear'}),
            ('trapezoidal, 50 µs', 5e-5, RecursiveForward, {}),
            ('trapezoidal, 25 µs', 2.5e-5, RecursiveForward, {})):
        every = round(step / fine)
        found = kind(bay, VEHICLE, (0.0,), step, 0.0, **options).run(
            x[::every], r[::every]).contact_force[:, 0]
        settled = slice(found.size // 5, None)
        window = {'fs': 1.0 / step, 'nperseg': round(0.02 / step)}
        f, error = signal.welch(found[settled] - truth[::every][settled], **window)
        _, power = signal.welch(truth[::every][settled], **window)
        axis.semilogy(f, 100.0 * np.sqrt(error / power), label=label)
        within = [(f >= a) & (f < b) for a, b in ((30, 500), (500, 1500), (1500, 2500),
                                                  (2500, 5000))]
        shares = [100.0 * math.sqrt(error[w].sum() / power[w].sum()) for w in within]
        print(f'| {label} | ' + ' | '.join(f'{share:.2g}' for share in shares) + ' |', flush=True)
    axis.set(xlim=(0, 5000), ylim=(0.01, 200), xlabel='frequency, Hz',
             ylabel='error of the contact force, % at each frequency')
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(folder / 'online_error_by_frequency.png', dpi=90)


def inverse(folder: Path) -> None:
    """Irregularity from acceleration, one-third octaves, second wheel present."""
    vehicle = dataclasses.replace(VEHICLE, axle_boxes=(
        AxleBox('lead', 'left', 0.0), AxleBox('trail', 'left', -2.5)))
    bands = [10**(-k / 10) for k in range(4, 21)]  # 0.4 m to 10 mm
    figure, axis = plt.subplots(figsize=(7, 4), layout='constrained')
    for rate in (10e3, 20e3, 25.6e3):
        for speeds in ((30.0, 30.0), (25.0, 41.0)):
            x, r = run(speeds, 0.5 / rate, 2.0, (0.0, -2.5), True)
            truth = FullModel(bay_of('distributed', Mesh(10)), vehicle, (0.0, -2.5), 0.5 / rate,
                              0.0).run(x, r)
            for noise in (0.0, 0.5) if rate == 20e3 else (0.0,):
                a = truth.axle_box_acceleration[::2].copy()
                a += noise * np.random.default_rng(0).standard_normal(a.shape)
                force, found = estimated(vehicle, a, rate, speeds)
                good = np.isfinite(found[:, 0])
                difference = force[good] - truth.contact_force[::2][good]
                level = [band_errors(x[::2][good], found[good, w], r[::2][good, w], bands)
                         for w in range(2)]
                worst = np.abs(level).max(axis=0)
                long = max(e for e, b in zip(worst, bands, strict=True) if b > 0.018)
                short = max(e for e, b in zip(worst, bands, strict=True) if b < 0.018)
                label = f'{rate / 1e3:g} kHz, {speeds[0]:g} to {speeds[1]:g} m/s'
                print(f'| {label} | {noise:g} | {long:.2f} | {short:.2f} | '
                      f'{np.std(difference):.3g} | {550 * noise:g} |', flush=True)
                if noise == 0.0:
                    axis.semilogx(1e3 * np.array(bands), worst, 'o-', label=label)
    axis.axhline(0.5, color='0.7', zorder=0)
    axis.set(xlabel='wavelength, mm', ylabel='error of the level, dB', ylim=(0.0, 2.0))
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(folder / 'online_inverse.png', dpi=90)


def feed(estimator: Estimator, a: np.ndarray, rate: float, speeds: tuple[float, float]
         ) -> list[Any]:
    """Blocks of the estimator for accelerations (n, 2)."""
    duration = len(a) / rate
    for k in range(-10, round(100 * duration) + 3):
        estimator.add_speed(SECOND + k * SECOND // 100,
                            speeds[0] + (speeds[1] - speeds[0]) * k / 100 / duration)
    return [estimator.process(
        SECOND + round(k / rate * SECOND), np.arange(len(a[k:k + 256])) / rate,
        {'lead': a[k:k + 256, 0], 'trail': a[k:k + 256, 1]}) for k in range(0, len(a), 256)]


def estimated(vehicle: Any, a: np.ndarray, rate: float, speeds: tuple[float, float]
              ) -> tuple[np.ndarray, np.ndarray]:
    """Force and irregularity (n, 2) by the estimator."""
    blocks = feed(Estimator(bay_of('distributed').track, vehicle), a, rate, speeds)
    force, irregularity = (np.column_stack([
        np.concatenate([getattr(block, what)[name] for block in blocks])
        for name in ('lead', 'trail')]) for what in ('contact_force', 'irregularity'))
    return force, irregularity


def model_residual() -> None:
    """Share of the acceleration of the wheel behind that the model leaves unexplained, 25 m/s."""
    rate, bogie = 25600.0, dataclasses.replace(VEHICLE, axle_boxes=(
        AxleBox('lead', 'left', 0.0), AxleBox('trail', 'left', -2.5)))
    position, irregularity = run((25.0, 25.0), 0.5 / rate, 2.2, (0.0, -2.5), rough=True)
    truth = FullModel(bay_of('distributed', Mesh(10)), bogie, (0.0, -2.5), 0.5 / rate, 0.0)
    a = truth.run(position, irregularity).axle_box_acceleration[::2]
    print('| pad stiffness assumed | ' + ' | '.join(BANDS) + ' |')
    for factor in (1.0, 0.6, 1.5):
        track = bay_of('distributed').track
        support = dataclasses.replace(
            track.support, pad_stiffness=factor * track.support.pad_stiffness)
        estimator = Estimator(dataclasses.replace(track, support=support), bogie)
        feed(estimator, a, rate, (25.0, 25.0))
        found = estimator.model_residual()['trail']
        print(f'| {factor:g} | ' + ' | '.join(
            f'{100.0 * found[band].share:.1f} %' for band in BANDS) + ' |', flush=True)


def band_errors(x: np.ndarray, found: np.ndarray, truth: np.ndarray, bands: Sequence[float]
                ) -> list[float]:
    """Levels found minus true [dB] of one-third octaves."""
    grid = np.arange(x[0] + 6.0, x[-1], 0.0005)
    result = []
    for centre in bands:
        edges = [10**-0.05 / centre, 10**0.05 / centre]
        band = signal.butter(3, edges, 'bandpass', fs=2000.0, output='sos')
        levels = [np.std(signal.sosfiltfilt(band, np.interp(grid, x, y))[2000:-2000])
                  for y in (found, truth)]
        result.append(20.0 * math.log10(levels[0] / levels[1]))
    return result


if __name__ == '__main__':
    images = Path(sys.argv[1])
    images.mkdir(parents=True, exist_ok=True)
    wanted = sys.argv[2:] or ['forward', 'ring', 'frequency', 'inverse', 'residual']
    if 'forward' in wanted:
        forward_table()
    if 'ring' in wanted:
        ring_and_poles(images)
    if 'frequency' in wanted:
        error_by_frequency(images)
    if 'inverse' in wanted:
        inverse(images)
    if 'residual' in wanted:
        model_residual()
