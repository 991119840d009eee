"""Colours and words that every figure of the report shares."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

INK = '#1d2733'
MUTED = '#66727f'
GRID = '#e6eaee'
LIMIT = '#c8322b'
RAIL_COLOURS = {'left': '#00778f', 'right': '#8a3f9e'}
PAIR_COLOURS = ('#1456a0', '#e0800a', '#5a9c3a')

RMS = re.compile(r'rms_([0-9p]+)_([0-9p]+)_um')

FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif'


@dataclass(frozen=True)
class Line:
    """How a role is drawn and called."""

    name: str
    colour: str
    width: float
    dash: str = 'solid'


LINES = {
    'truth': Line('true', '#aab4be', 4.5),
    'measured': Line('measured', '#aab4be', 4.5),
    'full_model': Line('full model', '#e0800a', 2.0),
    'estimated': Line('estimated', '#1456a0', 1.3),
    'first': Line('first', '#aab4be', 4.0),
    'second': Line('second', '#1456a0', 1.6),
    'limit': Line('ISO 3095 limit', LIMIT, 1.6, 'dash'),
}

def bands(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the columns of band RMS that occur in rows of indicators, in their order."""
    return list(dict.fromkeys(name for row in rows for name in row if RMS.fullmatch(name)))


def band_limits(column: str) -> tuple[float, float]:
    """Return shortest and longest wavelength [mm] of a column such as ``rms_30_100_um``."""
    found = RMS.fullmatch(column)
    assert found is not None
    shortest, longest = (float(text.replace('p', '.')) for text in found.groups())
    return shortest, longest


def band_title(column: str) -> str:
    """``rms_30_100_um`` -> ``30-100 mm``."""
    return '{:g}-{:g} mm'.format(*band_limits(column))


def box_title(name: str) -> str:
    """``axle1_left`` -> ``axle 1 left``: the name of an axle box as a reader would write it."""
    words = name.replace('_', ' ')
    return ''.join(
        f' {c}' if c.isdigit() and i and words[i - 1].isalpha() else c
        for i, c in enumerate(words)
    )
