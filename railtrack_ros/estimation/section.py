"""The indicators of one section of track under one axle box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.estimation import wavelengths, waves
from railtrack_ros.estimation.bands import Band, band_name, band_title, grid_step, stride
from railtrack_ros.estimation.limits import LimitSet
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings

Signal = NDArray[np.float32]

OK, WARN, ERROR = 0, 1, 2
LEVELS = ('OK', 'WARN', 'ERROR')

# Resolved are waves of at least so many samples, and those this much shorter than the cut-on.
# With fewer the estimate loses more than 0.6 dB: forces are known at the samples alone.
SAMPLES_A_WAVE = 5.0
# A band reaches down to so many: of roughness it loses a twentieth at most, of a wave at its very
# end 2 dB.
SAMPLES_A_WAVE_OF_BAND = 3.0
CUT_ON_MARGIN = 1.5

# Peak-to-peak values are averaged over so many of a band's longest waves.
PEAK_WINDOW = 10.0


def columns(bands: Sequence[Band]) -> tuple[str, ...]:
    """Return the names of a section's values."""
    names = [band_name(band) for band in bands]
    return (
        'axle_box', 'rail', 'from_m', 'to_m', 'speed_m_s',
        *(f'rms_{name}_um' for name in names),
        'dominant_wavelength_m', 'dominant_rms_um', 'dominant_above_iso3095_db', 'valid_fraction',
        'dominant_depth_um',
        *(f'peak_to_peak_{name}_um' for name in names),
        *(f'above_limit_{name}_percent' for name in names),
        'impacts', 'level',
    )  # fmt: skip


@dataclass(frozen=True)
class Section:
    """Indicators of one section under one axle box; NaN stands for what cannot be resolved.

    start, end [m]: place on the track. speed [m/s]: mean. By band: rms (bands,) [m] of the
    irregularity; peak_to_peak (bands,) [m], the largest moving average of the peak-to-peak values
    (over ten of the band's longest waves, at most the section); above (bands,), which share of the
    section is above the limit; ratio (bands,) of the whole section's mean to the limit.
    dominant_wavelength [m]: peak of the spectrum relative to the ISO 3095 limit, with the RMS [m]
    in the sixth of an octave around it and its level above the limit [dB]. valid_fraction: share
    of the section with irregularity. impacts: blows, as of joints and switches. level: OK, WARN
    (more than the allowed share above a limit) or ERROR (the whole section's mean is above it),
    with the reason.
    """

    axle_box: str
    rail: str
    start: float
    end: float
    speed: float
    bands: tuple[Band, ...]
    rms: tuple[float, ...]
    dominant_wavelength: float
    dominant_rms: float
    dominant_above_limit: float
    valid_fraction: float
    peak_to_peak: tuple[float, ...] = ()
    above: tuple[float, ...] = ()
    ratio: tuple[float, ...] = ()
    impacts: int = 0
    level: int = OK
    reason: str = ''

    @property
    def depth(self) -> float:
        """Depth of the dominant wave from crest to trough [m], that of a sine of its RMS."""
        return 2.0 * math.sqrt(2.0) * self.dominant_rms

    def row(self) -> dict[str, str | float | int | None]:
        """Return the values by the names of :func:`columns`; None where not resolved."""
        values = (
            self.start, self.end, self.speed, *(1e6 * rms for rms in self.rms),
            self.dominant_wavelength, 1e6 * self.dominant_rms, self.dominant_above_limit,
            self.valid_fraction, 1e6 * self.depth, *(1e6 * height for height in self.peak_to_peak),
            *(100.0 * share for share in self.above),
        )  # fmt: skip
        known = (None if math.isnan(value) else value for value in values)
        row = (self.axle_box, self.rail, *known, self.impacts, LEVELS[self.level])
        return dict(zip(columns(self.bands), row, strict=True))


@dataclass(frozen=True)
class Passage:
    """What an axle box has met on its way over a section, on a grid in distance.

    irregularity (n,) [m] every `step` [m], and signals: that in each band, every `stride`-th
    point; NaN where not valid. coarsest [m]: largest distance of two samples; fastest [m/s].
    before, after: the signals on either side, as far as a blow is long and they are known.
    """

    irregularity: Signal
    signals: Sequence[Signal]
    step: float
    speed: float
    coarsest: float
    fastest: float
    before: Sequence[Signal]
    after: Sequence[Signal]


class Judge:
    """Sums up passages over sections by the settings, the same way live and in the analysis."""

    def __init__(self, settings: IndicatorSettings, estimator: EstimatorSettings,
                 limits: LimitSet) -> None:
        self.settings, self.estimator, self.limits = settings, estimator, limits
        self.bands = settings.wavelengths
        self.step = grid_step(self.bands)  # m, of the grid that passages are on

    def shortest(self, passage: Passage) -> float:
        """Return the shortest wavelength [m] that sampling and track model resolve."""
        return max(SAMPLES_A_WAVE * passage.coarsest,
                   passage.fastest / self.estimator.maximum_frequency)

    @property
    def longest(self) -> float:
        """The longest wavelength [m] that the high-pass of the estimate lets by untouched."""
        return self.estimator.cut_on_wavelength / CUT_ON_MARGIN

    def resolved(self, band: Band, spacing: ArrayLike, speed: ArrayLike) -> NDArray[np.bool_]:
        """Tell whether a band can be resolved.

        spacing and speed: distance of the samples [m] and speed [m/s], of any shape.
        """
        by_model = np.asarray(speed, dtype=float) / self.estimator.maximum_frequency
        shortest = np.maximum(SAMPLES_A_WAVE_OF_BAND * np.asarray(spacing, dtype=float), by_model)
        return np.asarray((band[0] >= shortest) & (band[1] <= self.longest))

    def section(self, axle_box: str, rail: str, index: int, passage: Passage) -> Section:
        """Return the indicators of the section of number `index`."""
        length, step = self.settings.section_length, passage.step
        count = len(self.bands)
        rms, heights, above, ratio = ([math.nan] * count for _ in range(4))
        blows: list[float] | None = None
        for b, (band, values) in enumerate(zip(self.bands, passage.signals, strict=True)):
            apart = stride(band, step) * step
            good, squares = waves.square_sum(values)
            enough = good * apart >= self.settings.minimum_valid * length - 0.5 * apart
            if not (enough and self.resolved(band, passage.coarsest, passage.fastest)):
                continue
            rms[b] = math.sqrt(squares / good)
            heights[b] = waves.largest_mean_peak_to_peak(values, apart, PEAK_WINDOW * band[1])
            limit = self.limits.of(band)
            if limit is not None:
                above[b], ratio[b] = waves.above(values, apart, self.limits.statistic, limit)
            if blows is None:
                blows = waves.impacts(values, apart, passage.before[b], passage.after[b])
        valid = np.count_nonzero(np.isfinite(passage.irregularity)) * step / length
        spectrum = None
        if valid >= self.settings.minimum_valid:
            spectrum = wavelengths.spectrum(passage.irregularity, step)
        shortest = max(min(band[0] for band in self.bands), self.shortest(passage))
        wavelength, peak, level = wavelengths.dominant(
            spectrum, shortest, min(max(band[1] for band in self.bands), self.longest),
            self.settings.minimum_prominence)
        status, reason = self.judge(above, ratio)
        return Section(
            axle_box=axle_box, rail=rail, start=index * length, end=(index + 1) * length,
            speed=passage.speed, bands=self.bands, rms=tuple(rms), dominant_wavelength=wavelength,
            dominant_rms=peak, dominant_above_limit=level, valid_fraction=min(valid, 1.0),
            peak_to_peak=tuple(heights), above=tuple(above), ratio=tuple(ratio),
            impacts=len(blows or ()), level=status, reason=reason,
        )  # fmt: skip

    def judge(self, above: Sequence[float], ratio: Sequence[float]) -> tuple[int, str]:
        """Return the worst level of the bands, and what it is about.

        above (bands,) and ratio (bands,) as in :class:`Section`.
        """
        worst, reason, worst_ratio = OK, '', 0.0
        for band, share, mean in zip(self.bands, above, ratio, strict=True):
            limit = self.limits.of(band)
            if limit is None or math.isnan(mean):
                continue
            level = ERROR if mean > 1.0 else WARN if share > limit.allowed_share else OK
            if level > worst or (level == worst and mean > worst_ratio and level):
                worst, worst_ratio = level, mean
                reason = (f'{band_title(band)}: {mean:.1f} times the limit of {self.limits.title}'
                          if level == ERROR else
                          f'{band_title(band)}: {100.0 * share:.0f} % above the limit of '
                          f'{self.limits.title}')
        return worst, reason
