"""Spectra of the irregularity over a replayed stretch, window by window and together."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from railtrack_ros.irregularity.spectra import REFERENCE, iso3095_limit
from railtrack_ros.report.content import Spectrum
from railtrack_ros.runs import comparison
from railtrack_ros.runs.replay_model import Replayed
from railtrack_ros.vehicle.description import Vehicle

LONGEST = 10.0**0.15      # [m] upper edge of the 1.25 m one-third octave


def spectra(found: Replayed, vehicle: Vehicle) -> dict[str, Spectrum]:
    """Levels of estimated and true irregularity over the stretch, in the wavelengths resolved."""
    result = {}
    speed = np.abs(found.samples.speed[found.stretch])
    for box in vehicle.axle_boxes:
        signals = {who: channels[box.name][found.stretch]
                   for who, channels in found.signals('irregularity').items()
                   if box.name in channels}
        finite = np.all([np.isfinite(x) for x in signals.values()], axis=0) & (speed > 0.0)
        part = comparison.longest_piece(finite)
        run = np.cumsum(speed[part]) * found.samples.time_step
        if run.size < comparison.SHORTEST:
            continue
        mean = float(speed[part].mean())
        step = mean * found.samples.time_step
        grid = np.arange(run[0], run[-1], step)
        on_grid = {who: np.interp(grid, run, x[part]) for who, x in signals.items()}
        levels = comparison.band_levels(
            on_grid['estimated'], on_grid.get('truth', on_grid['estimated']), step,
            LONGEST, mean / found.band.high)
        if levels is None:
            continue
        curves = {'limit': iso3095_limit(levels.centre),
                  'estimated': 20.0 * np.log10(levels.compared / REFERENCE)}
        if 'truth' in on_grid:
            curves['truth'] = 20.0 * np.log10(levels.reference / REFERENCE)
        result[box.name] = Spectrum(levels.centre, curves)
    return result


class WeightedSpectra:
    """Mean levels of the spectra of several windows, by energy and with weights."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str], dict[int, list[float]]] = {}

    def add(self, found: Mapping[str, Spectrum], weight: float) -> None:
        """Take the spectra of a window, by axle box."""
        for box, spectrum in found.items():
            band = np.rint(10.0 * np.log10(1.0 / spectrum.wavelength)).astype(int)
            for role, levels in spectrum.levels.items():
                sums = self._sums.setdefault((box, role), {})
                for number, level in zip(band.tolist(), levels.tolist(), strict=True):
                    total = sums.setdefault(number, [0.0, 0.0])
                    total[0] += weight * 10.0 ** (level / 10.0)
                    total[1] += weight

    def mean(self) -> dict[str, Spectrum]:
        """Return the mean levels by axle box."""
        result: dict[str, Spectrum] = {}
        for box in dict.fromkeys(box for box, _ in self._sums):
            roles = {role: sums for (name, role), sums in self._sums.items() if name == box}
            bands = sorted(set().union(*roles.values()))
            levels = {
                role: np.array([10.0 * np.log10(sums[k][0] / sums[k][1]) if k in sums else np.nan
                                for k in bands])
                for role, sums in roles.items()}
            result[box] = Spectrum(10.0 ** (-np.array(bands) / 10.0), levels)
        return result
