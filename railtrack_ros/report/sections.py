"""Indicators per section, put together per rail: what is above a limit, and where."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from railtrack_ros.report import style
from railtrack_ros.report.content import Array, Indicators


@dataclass(frozen=True)
class RailBand:
    """RMS of one band along one rail: sections ``(n,)``, their ends [m] and values [µm]."""

    start: Array
    end: Array
    mean: Array        # energy mean over the axle boxes of this rail
    low: Array
    high: Array


@dataclass(frozen=True)
class Exceedance:
    """Neighbouring sections of one rail whose RMS in one band is above its limit."""

    rail: str
    band: str
    start: float
    end: float
    worst: float                  # [µm] largest section RMS
    limit: float                  # [µm]
    wavelength: float | None      # [m] dominant one of the worst section, if of this band


def number(value: object) -> float:
    """Return a cell of an indicator row as a number, NaN for an empty or missing one."""
    if value is None or value == '':
        return float('nan')
    return float(value)  # type: ignore[arg-type]


def rails(indicators: Indicators) -> list[str]:
    """Return the rails that occur, in the order of their first row."""
    return list(dict.fromkeys(str(row['rail']) for row in indicators.rows))


def along_rail(indicators: Indicators, rail: str, band: str) -> RailBand:
    """Gather the sections of a rail; those that no axle box resolved are NaN."""
    found: dict[tuple[float, float], list[float]] = {}
    for row in indicators.rows:
        if row['rail'] == rail:
            ends = number(row['from_m']), number(row['to_m'])
            found.setdefault(ends, []).append(number(row.get(band)))
    keys = sorted(found)
    values = [np.array(found[k])[np.isfinite(found[k])] for k in keys]

    def each(reduce: Callable[[Array], float]) -> Array:
        return np.array([reduce(v) if v.size else np.nan for v in values], dtype=float)

    return RailBand(
        np.array([k[0] for k in keys], dtype=float), np.array([k[1] for k in keys], dtype=float),
        each(lambda v: np.sqrt(np.mean(v**2))), each(np.min), each(np.max),
    )


def exceedances(indicators: Indicators) -> list[Exceedance]:
    """Merge neighbouring sections above a limit, worst ones (relative to the limit) first."""
    found = []
    for band, limit in indicators.limits.items():
        for rail in rails(indicators):
            sections = along_rail(indicators, rail, band)
            above = np.flatnonzero(np.nan_to_num(sections.mean) > limit)
            for run in _neighbours(above, sections):
                worst = run[int(np.argmax(sections.mean[run]))]
                found.append(Exceedance(
                    rail, band, float(sections.start[run[0]]), float(sections.end[run[-1]]),
                    float(sections.mean[worst]), limit,
                    _dominant(indicators.rows, rail, band, float(sections.start[worst])),
                ))
    return sorted(found, key=lambda e: e.worst / e.limit, reverse=True)


def _neighbours(above: np.ndarray, sections: RailBand) -> list[np.ndarray]:
    """Split indices into runs of sections that touch one another."""
    if not above.size:
        return []
    touching = np.isclose(sections.start[above[1:]], sections.end[above[:-1]])
    return np.split(above, np.flatnonzero(~(touching & (np.diff(above) == 1))) + 1)


def _dominant(rows: Sequence[Mapping[str, object]], rail: str, band: str, start: float
              ) -> float | None:
    """Return the dominant wavelength [m] of a section, None where it is not one of the band."""
    shortest, longest = (1e-3 * end for end in style.band_limits(band))
    values = [number(r.get('dominant_wavelength_m')) for r in rows
              if r['rail'] == rail and number(r['from_m']) == start]
    finite = [v for v in values if shortest <= v <= longest]
    return float(np.median(finite)) if finite else None
