"""What a report shows, as plain data: no file, no plotting library, no mechanics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# What a curve stands for, in the order in which curves are drawn over one another.
ROLES = ('truth', 'measured', 'full_model', 'estimated', 'first', 'second')


@dataclass(frozen=True)
class Tile:
    """A key figure: ``value`` in large type, ``label`` above it and a remark below."""

    label: str
    value: str
    remark: str = ''


@dataclass(frozen=True)
class Waveform:
    """Curves of one axle box on a uniform grid along the track.

    ``start`` and ``step`` give the axle box's own position [m]; ``curves`` maps a role of
    `ROLES` to samples ``(n,)`` in SI units, NaN where there is no valid value.
    """

    start: float
    step: float
    curves: Mapping[str, Array]


@dataclass(frozen=True)
class WaveformPlot:
    """One quantity against position for several axle boxes.

    Values are multiplied by ``scale`` and labelled with ``unit`` (1e-3 and kN, for example).
    """

    title: str
    quantity: str
    unit: str
    scale: float
    axle_boxes: Mapping[str, Waveform]
    remark: str = ''


@dataclass(frozen=True)
class Spectrum:
    """One-third-octave levels of one axle box over wavelength.

    ``wavelength`` (k,) [m] holds the nominal band centres, ``levels`` maps a role to levels
    (k,) [dB re 1 µm], NaN where a band cannot be resolved.
    """

    wavelength: Array
    levels: Mapping[str, Array]


@dataclass(frozen=True)
class BandError:
    """Deviation between two signals in one-third octaves of frequency.

    ``frequency`` (k,) [Hz]; ``level_difference`` (k,) [dB], level of the first signal minus that
    of the second; ``wavelength`` (k,) [m] at the mean speed; ``coherence`` (k,) from 0 to 1, NaN
    or None where it is not known.
    """

    frequency: Array
    wavelength: Array
    level_difference: Array
    coherence: Array | None = None


@dataclass(frozen=True)
class ErrorPlot:
    """Band errors of one quantity: a pair such as 'estimated - true' -> axle box -> error.

    ``over`` says what they are drawn over: 'frequency' or 'wavelength'.
    """

    title: str
    pairs: Mapping[str, Mapping[str, BandError]]
    remark: str = ''
    over: str = 'frequency'


@dataclass(frozen=True)
class Latency:
    """Delay of live results: ``time`` (n,) [s] since the start, ``delay`` (n,) [s]."""

    time: Array
    delay: Array
    definition: str
    real_time_limit: float | None = None      # [s] length of a block: beyond it blocks pile up


@dataclass(frozen=True)
class Indicators:
    """Corrugation indicators per section, rows with the columns of ``railtrack indicators``.

    ``limits`` maps a band column (``rms_30_100_um``) to its limit [µm].
    """

    rows: Sequence[Mapping[str, object]]
    limits: Mapping[str, float]
    limit_source: str = ''


@dataclass(frozen=True)
class Table:
    """A small table; numbers come formatted."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    remark: str = ''


@dataclass(frozen=True)
class Card:
    """A part of the page: figures, each with heading, remark and a Plotly figure, and tables."""

    title: str
    figures: Sequence[tuple[str, str, Any]] = ()
    tables: Sequence[Table] = ()


@dataclass(frozen=True)
class Report:
    """Everything on the page; parts that are None or empty are left out."""

    title: str
    subtitle: str
    findings: Sequence[str]
    tiles: Sequence[Tile] = ()
    indicators: Indicators | None = None
    irregularity: WaveformPlot | None = None
    spectra: Mapping[str, Spectrum] = field(default_factory=dict)
    spectrum_remark: str = ''
    waveforms: Sequence[WaveformPlot] = ()
    errors: Sequence[ErrorPlot] = ()
    tables: Sequence[Table] = ()
    latency: Latency | None = None
    parameters: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    methods: Sequence[str] = ()
    highlight: tuple[float, float] | None = None   # [m] stretch of track marked in the strip chart
    axle_box: str = ''                             # shown first; else the first one
    cards: Sequence[Card] = ()                     # shown before all others
