"""Rows of the tables that an analysis of the rails gives: sections, spectra, wheels, grind list."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.dynamics.resonances import p2_resonances, track_resonances
from railtrack_ros.errors import InputError
from railtrack_ros.estimation import rails, roughness
from railtrack_ros.estimation.analysis import Analysis
from railtrack_ros.estimation.bands import band_title
from railtrack_ros.estimation.mechanism import TrackFrequencies, classify
from railtrack_ros.estimation.rails import BLOCKS, MERGE, RailSection, Stretch
from railtrack_ros.estimation.section import LEVELS, Judge
from railtrack_ros.estimation.wheels import pooled
from railtrack_ros.irregularity.profile import reason
from railtrack_ros.irregularity.spectra import iso3095_limit
from railtrack_ros.track.description import Rail, Support, Track
from railtrack_ros.vehicle.description import Contact, Vehicle, Wheel

Array = NDArray[np.float64]
Row = dict[str, str | float | int | None]

GRIND_COLUMNS = (
    'rank', 'rail', 'from_m', 'to_m', 'length_m', 'level', 'band_mm', 'statistic', 'worst_um',
    'limit_um', 'times_limit', 'above_limit_percent', 'dominant_wavelength_m', 'dominant_depth_um',
    'mechanism', 'mechanism_certainty', 'noise_index_db', 'axle_boxes', 'spread_db',
    'share_of_stretch_percent', 'longitude_deg', 'latitude_deg',
)  # fmt: skip

SPECTRUM_COLUMNS = (
    'rail', 'from_m', 'to_m', 'wavelength_m', 'combined_level_db', 'rail_level_db', 'iso3095_db',
    'rail_above_iso3095_db', 'contact_filter', 'excluded',
)  # fmt: skip
WHEEL_COLUMNS = (
    'axle_box', 'rail', 'from_m', 'to_m', 'reaches', 'revolutions', 'radius_m', 'order',
    'amplitude_um', 'uncertainty_um', 'level_db',
)  # fmt: skip


@dataclass(frozen=True)
class LineSpeed:
    """The speeds that a line is run at: from, to [m] and speed [m/s], (n,) each.

    Several over the same place are a history of speeds.
    """

    start: Array
    end: Array
    speed: Array

    def over(self, start: float, end: float) -> tuple[float, float] | None:
        """Return the lowest and the highest speed [m/s] over a stretch [m], None if unknown."""
        here = self.speed[(self.start < end) & (self.end > start)]
        return (float(here.min()), float(here.max())) if here.size else None


def read_line_speed(text: str) -> LineSpeed:
    """Read speeds: one V or LO:HI in m/s, or a CSV file with from_m, to_m and speed_m_s.

    Raises
    ------
    InputError
        Neither, or a value that is no speed.
    """
    parts = text.split(':')
    try:
        speeds = np.array([float(part) for part in parts])
    except ValueError:
        return _read_line_speed(Path(text))
    if len(parts) > 2 or not ((speeds > 0.0) & (speeds < 200.0)).all():
        raise InputError(f'line speed: expected V or LO:HI in m/s above 0, got {text!r}')
    everywhere = np.full(speeds.size, math.inf)
    return LineSpeed(-everywhere, everywhere, speeds)


def _read_line_speed(path: Path) -> LineSpeed:
    rows = []
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            for row in reader:
                try:
                    start, end, speed = (float(row[x]) for x in ('from_m', 'to_m', 'speed_m_s'))
                except (KeyError, TypeError, ValueError):
                    start = end = speed = math.nan
                if not (start < end and 0.0 < speed < 200.0):
                    raise InputError(
                        f'line speed {path}: line {reader.line_num}: expected numbers from_m < '
                        'to_m and speed_m_s above 0')
                rows.append((start, end, speed))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'line speed {path}: neither V nor LO:HI in m/s, nor a file: '
                         f'{reason(error)}') from error
    if not rows:
        raise InputError(f'line speed {path}: holds no line with from_m, to_m, speed_m_s')
    return LineSpeed(*np.array(rows).T)


@dataclass(frozen=True)
class Setting:
    """What the rows depend on besides the irregularity.

    frequencies: of this track, None where it is not known. line_speed: None: that of the
    measurement. contact_filter with the wheel's load [N] and radius [m]. merge [m]: stretches
    closer than this are one.
    """

    judge: Judge
    frequencies: TrackFrequencies | None = None
    line_speed: LineSpeed | None = None
    contact_filter: str = 'cnossos'
    load: float = 50e3
    radius: float = 0.46
    merge: float = MERGE

    def speeds(self, section: RailSection) -> tuple[float, float]:
        """Return lowest and highest speed of the traffic over a section [m/s]."""
        told = self.line_speed.over(section.start, section.end) if self.line_speed else None
        return told or (section.speed, section.speed)

    def levels(self, section: RailSection) -> tuple[Array, Array]:
        """Levels [dB re 1 um] at `roughness.CENTRES`: combined, and of the rail.

        The rail's are freed of the contact filter, and empty below 20 mm.
        """
        centres = roughness.CENTRES
        combined = section.levels(centres)
        taken = roughness.contact_filter(self.contact_filter, centres, self.load, self.radius)
        absolute = centres >= 0.99 * roughness.SHORTEST_ABSOLUTE
        return combined, np.where(absolute, combined - taken, math.nan)

    def noise(self, section: RailSection) -> float:
        """Return the noise index [dB] at the fastest speed of the traffic."""
        return roughness.noise_index(
            roughness.CENTRES, self.levels(section)[1], self.speeds(section)[1])

    def mechanism(self, section: RailSection, wavelength: float) -> tuple[str, str]:
        """Return candidates and certainty for a wavelength [m], empty without it or the track."""
        if self.frequencies is None or math.isnan(wavelength):
            return '', ''
        found = classify(wavelength, self.speeds(section), self.frequencies)
        return ' or '.join(found.candidates), found.certainty


def described_track(content: Mapping[str, Any]) -> Track | None:
    """Return the track that a recording's configuration describes, None where it does not."""
    try:
        rail, support = Rail(**content['track']['rail']), Support(**content['track']['support'])
        uneven = content['track'].get('stretches') or content['track'].get('sleepers')
        return None if uneven else Track(str(content['track']['name']), rail, support)
    except (KeyError, TypeError):
        return None


def described_wheels(content: Mapping[str, Any]) -> Vehicle | None:
    """Return the wheels and contacts that a recording's configuration describes, or None."""
    try:
        told = content['vehicle']['wheel']
        wheel = Wheel(float(told['mass']), float(told['static_load']), float(told['radius']))
        contact = Contact(**content['vehicle']['contact'])
        return Vehicle(str(content['vehicle']['name']), wheel, contact, ())
    except (KeyError, TypeError, ValueError):
        return None


def track_frequencies(track: Track, vehicle: Vehicle) -> TrackFrequencies:
    """Find this track's own frequencies under this vehicle's wheels."""
    found = track_resonances(track)

    def mean(*names: str) -> tuple[float, ...]:
        each = [[r.frequency for r in found if r.name == name] for name in names]
        return tuple(float(np.mean(values)) for values in each if values)

    p2 = [resonance.frequency for resonance in p2_resonances(track, vehicle)]
    return TrackFrequencies(
        (float(np.mean(p2)),) if p2 else (), mean('in-phase', 'out-of-phase'),
        mean('pinned-pinned'), track.support.spacing)


def rail_rows(found: Analysis, setting: Setting) -> list[Row]:
    """Rows of the sections of each rail, then of blocks of 50, 100 and 200 m.

    `block_m` is the length that a row is about.
    """
    length = setting.judge.settings.section_length
    groups = [(length, found.rails)]
    groups += [(block, rails.blocks(found.rails, block, setting.judge))
               for block in BLOCKS if block > length]
    rows = []
    for block, sections in groups:
        noise = [setting.noise(section) for section in sections]
        due = dict(_due(sections, noise))
        for number, (section, index) in enumerate(zip(sections, noise, strict=True)):
            mechanism, certainty = setting.mechanism(section, section.dominant_wavelength)
            row: Row = {'block_m': block, **rails.row(section)}
            row.update({
                'mechanism': mechanism, 'mechanism_certainty': certainty,
                'noise_index_db': None if math.isnan(index) else index,
                'noise_rule': due[number]})  # fmt: skip
            rows.append(row)
    return rows


def _due(sections: Sequence[RailSection], noise: Sequence[float]) -> list[tuple[int, str]]:
    found: list[tuple[int, str]] = []
    for rail in dict.fromkeys(section.rail for section in sections):
        mine = [n for n, section in enumerate(sections) if section.rail == rail]
        words = roughness.grinding_due(
            np.array([sections[n].start for n in mine]), np.array([sections[n].end for n in mine]),
            np.array([noise[n] for n in mine]))
        found += zip(mine, words, strict=True)
    return found


def spectrum_rows(found: Analysis, setting: Setting) -> list[Row]:
    """Rows of one-third-octave levels, one for each section of a rail and band resolved."""
    limit = iso3095_limit(roughness.CENTRES)
    rows: list[Row] = []
    for section in found.rails:
        combined, rail = setting.levels(section)
        for n in np.flatnonzero(np.isfinite(combined)):
            absolute = math.isfinite(rail[n])
            values = (
                section.rail, section.start, section.end, float(roughness.CENTRES[n]),
                float(combined[n]), float(rail[n]) if absolute else None, float(limit[n]),
                float(rail[n] - limit[n]) if absolute else None, setting.contact_filter,
                'yes' if section.excluded else 'no')  # fmt: skip
            rows.append(dict(zip(SPECTRUM_COLUMNS, values, strict=True)))
    return rows


def wheel_rows(found: Analysis) -> list[Row]:
    """Rows of the wheels' out-of-roundness by order; one empty row for a wheel that is round.

    First the mean of each wheel over all reaches, then reach by reach where there are several.
    """
    rows: list[Row] = []
    means = pooled(found.wheels)
    several = [wheel for wheel in found.wheels
               if any(m.axle_box == wheel.axle_box and m.reaches > 1 for m in means)]
    for wheel in (*means, *several):
        place = (wheel.axle_box, wheel.rail, min(wheel.start, wheel.end),
                 max(wheel.start, wheel.end), wheel.reaches, wheel.revolutions)  # fmt: skip
        if math.isnan(wheel.radius):
            rows.append(dict(zip(WHEEL_COLUMNS, (*place, *[None] * 5), strict=True)))
            continue
        for order, (amplitude, doubt) in enumerate(
            zip(wheel.amplitude.tolist(), wheel.uncertainty.tolist(), strict=True), 1
        ):
            level = 10.0 * math.log10(0.5 * amplitude**2 / 1e-12) if amplitude > 0.0 else None
            values = (*place, wheel.radius, order, 1e6 * amplitude, 1e6 * doubt, level)
            rows.append(dict(zip(WHEEL_COLUMNS, values, strict=True)))
    return rows


def grind_rows(stretches: Sequence[Stretch], setting: Setting, geography: Any = None) -> list[Row]:
    """Rows of the stretches to grind, in their order; the worst section speaks for each."""
    rows: list[Row] = []
    for rank, stretch in enumerate(stretches, 1):
        worst, band = stretch.worst, stretch.worst.bands[stretch.band]
        limit = setting.judge.limits.of(band)
        assert limit is not None
        wavelength, depth = stretch.wave
        mechanism, certainty = setting.mechanism(worst, wavelength)
        noise, spread = setting.noise(worst), worst.spread[stretch.band]
        place = geography.at(0.5 * (stretch.start + stretch.end)) if geography else (None, None)
        values = (
            rank, stretch.rail, stretch.start, stretch.end, stretch.end - stretch.start,
            LEVELS[rails.level_in(worst, stretch.band, setting.judge)],
            band_title(band).removesuffix(' mm'), setting.judge.limits.statistic,
            1e6 * stretch.ratio * limit.limit, 1e6 * limit.limit, stretch.ratio,
            100.0 * worst.above[stretch.band], wavelength, 1e6 * depth, mechanism,
            certainty, noise, worst.axle_boxes, spread,
            100.0 * stretch.share, *place)  # fmt: skip
        rows.append({
            name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in zip(GRIND_COLUMNS, values, strict=True)})
    return rows
