"""Sections of a rail: several axle boxes fused into one, blocks of sections, what to grind."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.estimation import wavelengths
from railtrack_ros.estimation.bands import Band, band_name, band_title
from railtrack_ros.estimation.section import LEVELS, OK, Judge, Section
from railtrack_ros.estimation.wavelengths import Spectrum

Array = NDArray[np.float64]

BLOCKS = (50.0, 100.0, 200.0)  # m

# A joint strikes every wheel: a section is excluded if at least this share of the axle boxes met a
# blow in it.
STRUCK = 0.5

# A wave stands out inside its band if it exceeds the band's median by this [dB].
IN_BAND = 3.0

# Stretches above a limit that are closer than this are ground in one go [m].
MERGE = 20.0


@dataclass(frozen=True)
class RailSection:
    """A section or block of one rail, from all axle boxes that ran over it.

    rms, peak_to_peak [m], above, ratio (bands,) as in :class:`Section`, of the axle boxes together;
    spread (bands,) [dB]: standard deviation of their levels, NaN for one alone. excluded: struck by
    blows, as over joints and switches, and left out of averages; in a block `sections` are those
    inside it and `excluded_sections` those left out. spectrum: mean of the powers.
    """

    rail: str
    start: float
    end: float
    speed: float
    bands: tuple[Band, ...]
    axle_boxes: int
    rms: tuple[float, ...]
    spread: tuple[float, ...]
    peak_to_peak: tuple[float, ...]
    above: tuple[float, ...]
    ratio: tuple[float, ...]
    dominant_wavelength: float
    dominant_rms: float
    dominant_above_limit: float
    spectrum: Spectrum | None
    shortest: float
    longest: float
    impacts: int = 0
    excluded: bool = False
    sections: int = 1
    excluded_sections: int = 0
    level: int = OK
    reason: str = ''

    @property
    def depth(self) -> float:
        """Depth of the dominant wave from crest to trough [m], that of a sine of its RMS."""
        return 2.0 * math.sqrt(2.0) * self.dominant_rms

    def levels(self, centres: Array) -> Array:
        """One-third-octave levels [dB re 1 um] at centres [m], NaN where not resolved."""
        if self.spectrum is None:
            return np.full(centres.shape, math.nan)
        half = 10.0**0.05
        resolved = (centres / half >= self.shortest * (1.0 - 1e-6)) & (
            centres * half <= min(self.longest, wavelengths.LONGEST_SHARE * self.spectrum.length))
        return np.where(resolved, self.spectrum.levels(centres), math.nan)


@dataclass(frozen=True)
class Measured:
    """A section under one axle box with its spectrum and the range that it resolves [m]."""

    section: Section
    spectrum: Spectrum | None
    shortest: float
    longest: float


def fuse(measured: Sequence[Measured], judge: Judge) -> list[RailSection]:
    """Fuse the axle boxes that ran over each section of a rail, in order of rail and place.

    The mean square is the mean over the axle boxes, from three on the median, which one bad wheel
    does not move; those without a blow go first.
    """
    places: dict[tuple[str, float], list[Measured]] = {}
    for item in measured:
        places.setdefault((item.section.rail, item.section.start), []).append(item)
    return [_fused(places[key], judge) for key in sorted(places)]


def _fused(items: list[Measured], judge: Judge) -> RailSection:
    struck = [item for item in items if item.section.impacts]
    excluded = len(struck) >= STRUCK * len(items)
    used = items if excluded else [item for item in items if not item.section.impacts]
    sections = [item.section for item in used]
    squares = np.array([section.rms for section in sections]) ** 2
    peaks = np.array([section.peak_to_peak for section in sections]) ** 2
    spectra = [item.spectrum for item in used if item.spectrum is not None]
    bands = sections[0].bands
    return _rail_section(
        judge, sections[0], bands, speed=float(np.mean([s.speed for s in sections])),
        axle_boxes=len(sections), squares=_middle(squares), spread=_spread(squares),
        peak_squares=_middle(peaks), above=_mean([s.above for s in sections]),
        ratio=np.sqrt(_middle(np.array([s.ratio for s in sections]) ** 2)), spectra=spectra,
        shortest=max(item.shortest for item in used), longest=min(item.longest for item in used),
        end=sections[0].end, impacts=max(item.section.impacts for item in items),
        excluded=excluded)  # fmt: skip


def blocks(sections: Sequence[RailSection], length: float, judge: Judge) -> list[RailSection]:
    """Sum up the sections of each rail in blocks of some length [m]; excluded ones are left out."""
    groups: dict[tuple[str, int], list[RailSection]] = {}
    for section in sections:
        middle = 0.5 * (section.start + section.end)
        groups.setdefault((section.rail, math.floor(middle / length)), []).append(section)
    found = []
    for (_, number), members in sorted(groups.items()):
        used = [section for section in members if not section.excluded]
        if not used:
            continue
        squares = np.array([section.rms for section in used]) ** 2
        block = _rail_section(
            judge, used[0], used[0].bands, speed=float(np.mean([s.speed for s in used])),
            axle_boxes=max(s.axle_boxes for s in used), squares=_mean(squares),
            spread=np.sqrt(_mean(np.array([s.spread for s in used]) ** 2)),
            peak_squares=_largest(np.array([s.peak_to_peak for s in used])) ** 2,
            above=_mean([s.above for s in used]),
            ratio=np.sqrt(_mean(np.array([s.ratio for s in used]) ** 2)),
            spectra=[s.spectrum for s in used if s.spectrum is not None],
            shortest=max(s.shortest for s in used), longest=min(s.longest for s in used),
            start=number * length, end=(number + 1) * length,
            impacts=sum(s.impacts for s in members), sections=len(members),
            excluded_sections=len(members) - len(used))  # fmt: skip
        found.append(block)
    return found


def _rail_section(judge: Judge, first: Section | RailSection, bands: tuple[Band, ...], *,
                  speed: float, axle_boxes: int, squares: Array, spread: Array,
                  peak_squares: Array, above: Array, ratio: Array, spectra: list[Spectrum],
                  shortest: float, longest: float, end: float, start: float | None = None,
                  impacts: int = 0, excluded: bool = False, sections: int = 1,
                  excluded_sections: int = 0) -> RailSection:
    spectrum = wavelengths.mean_spectrum(spectra) if spectra else None
    wavelength, rms, standing = wavelengths.dominant(
        spectrum, max(min(band[0] for band in bands), shortest),
        min(max(band[1] for band in bands), longest), judge.settings.minimum_prominence)
    level, reason = judge.judge(above.tolist(), ratio.tolist())
    return RailSection(
        first.rail, first.start if start is None else start, end, speed, bands, axle_boxes,
        tuple(np.sqrt(squares).tolist()), tuple(spread.tolist()),
        tuple(np.sqrt(peak_squares).tolist()), tuple(above.tolist()), tuple(ratio.tolist()),
        wavelength, rms, standing, spectrum, shortest, longest, impacts, excluded, sections,
        excluded_sections, level, reason)  # fmt: skip


@dataclass(frozen=True)
class Stretch:
    """A stretch of one rail above the limit of one band; its worst section speaks for it.

    band: index of the band; worst: that section; share: length of the sections above the limit
    relative to the stretch's.
    """

    rail: str
    start: float
    end: float
    band: int
    worst: RailSection
    share: float

    @property
    def ratio(self) -> float:
        """Mean of the worst section over the limit."""
        return self.worst.ratio[self.band]

    @property
    def wave(self) -> tuple[float, float]:
        """Wavelength and depth [m] of what stands out inside the band, NaN if nothing does."""
        shortest, longest = self.worst.bands[self.band]
        wavelength, rms, _ = wavelengths.dominant(
            self.worst.spectrum, max(shortest, self.worst.shortest),
            min(longest, self.worst.longest), IN_BAND)  # fmt: skip
        return wavelength, 2.0 * math.sqrt(2.0) * rms


def stretches(sections: Sequence[RailSection], judge: Judge, merge: float = MERGE
              ) -> list[Stretch]:
    """Merge the sections of each rail that are not OK in a band into stretches, the worst first.

    They are ranked by the worst ratio to the limit times the root of their length: a long stretch
    goes before a short one that is a little worse. Excluded sections neither begin nor end one.
    """
    found = []
    for rail in dict.fromkeys(section.rail for section in sections):
        mine = sorted((s for s in sections if s.rail == rail and not s.excluded),
                      key=lambda s: s.start)
        for band in range(len(judge.bands)):
            groups: list[list[RailSection]] = []
            for section in mine:
                if level_in(section, band, judge) == OK:
                    continue
                if groups and section.start - groups[-1][-1].end <= merge + 1e-6:
                    groups[-1].append(section)
                else:
                    groups.append([section])
            for group in groups:
                worst = max(group, key=lambda s: s.ratio[band])  # noqa: B023 (used at once)
                length = group[-1].end - group[0].start
                found.append(Stretch(
                    rail, group[0].start, group[-1].end, band, worst,
                    sum(s.end - s.start for s in group) / length))  # fmt: skip
    return sorted(found, key=lambda s: -s.ratio * math.sqrt(s.end - s.start))


def level_in(section: RailSection, band: int, judge: Judge) -> int:
    """Return OK, WARN or ERROR of a section in one band."""
    ratio, above = ([math.nan] * len(judge.bands) for _ in range(2))
    ratio[band], above[band] = section.ratio[band], section.above[band]
    return judge.judge(above, ratio)[0]


def length_of(found: Sequence[Stretch]) -> float:
    """Return the length of rail [m] in any of the stretches."""
    total = 0.0
    for rail in dict.fromkeys(stretch.rail for stretch in found):
        reached = -math.inf
        for stretch in sorted((s for s in found if s.rail == rail), key=lambda s: s.start):
            total += max(stretch.end - max(stretch.start, reached), 0.0)
            reached = max(reached, stretch.end)
    return total


def row(section: RailSection) -> dict[str, str | float | int | None]:
    """Return the values of a rail section by their column names; None where not resolved."""
    names = [band_name(band) for band in section.bands]

    def by_band(form: str, values: Sequence[float], scale: float = 1.0) -> Mapping[str, float]:
        return {form.format(name): scale * value
                for name, value in zip(names, values, strict=True)}

    numbers = {
        'from_m': section.start, 'to_m': section.end, 'speed_m_s': section.speed,
        **by_band('rms_{}_um', section.rms, 1e6), **by_band('spread_{}_db', section.spread),
        **by_band('peak_to_peak_{}_um', section.peak_to_peak, 1e6),
        **by_band('above_limit_{}_percent', section.above, 100.0),
        'dominant_wavelength_m': section.dominant_wavelength,
        'dominant_depth_um': 1e6 * section.depth,
        'dominant_above_iso3095_db': section.dominant_above_limit,
    }  # fmt: skip
    return {
        'rail': section.rail,
        **{name: None if math.isnan(value) else value for name, value in numbers.items()},
        'axle_boxes': section.axle_boxes, 'sections': section.sections,
        'excluded_sections': section.excluded_sections, 'impacts': section.impacts,
        'excluded': 'yes' if section.excluded else 'no', 'level': LEVELS[section.level],
    }  # fmt: skip


def describe(stretch: Stretch) -> str:
    """Return what a stretch is, in a line."""
    wave, _ = stretch.wave
    size = f'{stretch.ratio:.1f} times the limit' if stretch.ratio > 1.0 else (
        f'{100.0 * stretch.worst.above[stretch.band]:.0f} % above the limit')
    text = (f'{stretch.rail} rail, {stretch.start:g} to {stretch.end:g} m, '
            f'{band_title(stretch.worst.bands[stretch.band])}: {size}')
    return text + (f', {1e3 * wave:.0f} mm' if math.isfinite(wave) else '')


def _middle(values: Array) -> Array:
    """Mean over axis 0, from three finite values on their median; NaN without any."""
    found = np.full(values.shape[1], math.nan)
    for b, column in enumerate(values.T):
        good = column[np.isfinite(column)]
        if good.size:
            found[b] = np.median(good) if good.size > 2 else good.mean()
    return found


def _spread(squares: Array) -> Array:
    """Standard deviation [dB] over axis 0, NaN for fewer than two."""
    found = np.full(squares.shape[1], math.nan)
    for b, column in enumerate(squares.T):
        good = column[np.isfinite(column) & (column > 0.0)]
        if good.size > 1:
            found[b] = np.std(10.0 * np.log10(good), ddof=1)
    return found


def _mean(values: Sequence[Sequence[float]] | Array) -> Array:
    table = np.asarray(values, dtype=float)
    count = np.isfinite(table).sum(axis=0)
    return np.where(count > 0, np.nansum(table, axis=0) / np.maximum(count, 1), math.nan)


def _largest(values: Array) -> Array:
    return np.where(np.isfinite(values).any(axis=0), np.fmax.reduce(values, axis=0), math.nan)
