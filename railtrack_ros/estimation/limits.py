"""Limits of irregularity by band of wavelength, as data files with their source.

A file names its statistic and says which of its values are uncertain; docs/corrugation.md
explains both. The limit of ISO 3095, a spectrum in one-third octaves, is in
:mod:`railtrack_ros.irregularity.spectra`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from railtrack_ros import parameters, paths
from railtrack_ros.estimation.bands import Band
from railtrack_ros.parameters import POSITIVE, Range

STATISTICS = ('moving_rms', 'moving_peak_to_peak', 'peak_to_peak')
KEYS = ('limit', 'window', 'allowed_share')


@dataclass(frozen=True)
class BandLimit:
    """Limit [m] of a band: RMS or peak-to-peak by the set's statistic.

    window [m]: of the moving statistic, 0 without one. allowed_share: of the length, or of the
    peak-to-peak values, that may be above. uncertain: reasons by key.
    """

    band: Band
    limit: float
    window: float
    allowed_share: float
    uncertain: dict[str, str]


@dataclass(frozen=True)
class LimitSet:
    """Limits of one source."""

    name: str
    title: str
    source: str
    statistic: str
    bands: tuple[BandLimit, ...]

    def of(self, band: Band) -> BandLimit | None:
        """Return the limit of a band, None where the set has none for exactly that band."""
        return next((item for item in self.bands if item.band == band), None)


def load_limits(name_or_path: str | Path) -> LimitSet:
    """Read a shipped set of limits by its name, or a file by its path.

    Raises
    ------
    InputError
        No such set, or something in the file is not understood or impossible.
    """
    path = parameters.find_described('set of limits', name_or_path, _folder())
    file = parameters.read_yaml(path)
    file.expect(('title', 'source', 'statistic', 'bands'), ('uncertain',))
    statistic = file.choice('statistic', STATISTICS)
    doubts = _doubts(file)
    bands: list[BandLimit] = []
    for entry in file.sections('bands'):
        ranges = {'shortest': POSITIVE, 'longest': POSITIVE, 'limit': POSITIVE,
                  'allowed_share': Range(minimum=0.0, below=1.0)}  # fmt: skip
        if statistic != 'peak_to_peak':
            ranges['window'] = POSITIVE
        entry.expect(ranges)
        values = entry.numbers(ranges)
        band = (values['shortest'], values['longest'])
        if band[0] >= band[1]:
            raise entry.error('longest', f'expected more than shortest, {band[0]:g} m')
        if any(other.band == band for other in bands):
            raise entry.error('shortest', 'the band is given twice')
        name = f'{1e3 * band[0]:g}-{1e3 * band[1]:g}'
        bands.append(BandLimit(
            band, values['limit'], values.get('window', 0.0), values['allowed_share'],
            {key: reason for (key, where), reason in doubts.items() if where in ('', name)}))
    return LimitSet(
        path.stem, file.text('title'), ' '.join(file.text('source').split()), statistic,
        tuple(bands))


def _doubts(file: parameters.Section) -> dict[tuple[str, str], str]:
    """Return the reasons for uncertain values by key and band ('' for all)."""
    found = {}
    for entry in file.sections('uncertain') if 'uncertain' in file else ():
        entry.expect(('key', 'reason'), ('band',))
        found[entry.choice('key', KEYS), entry.text('band', '')] = entry.text('reason')
    return found


def shipped_limits() -> list[str]:
    """Return the names of the sets of limits that come with the program."""
    return parameters.shipped_names(_folder())


def _folder() -> Path:
    return paths.config_directory() / 'limits'
