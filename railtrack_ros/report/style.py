"""Colours and words that every figure of the report shares."""

from __future__ import annotations

from dataclasses import dataclass

INK = '#1d2733'
MUTED = '#66727f'
GRID = '#e6eaee'
LIMIT = '#c8322b'
RAIL_COLOURS = {'left': '#00778f', 'right': '#8a3f9e'}
PAIR_COLOURS = ('#1456a0', '#e0800a', '#5a9c3a')

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

BAND_NAMES = {
    'rms_10_30_um': '10-30 mm',
    'rms_30_100_um': '30-100 mm',
    'rms_100_300_um': '100-300 mm',
    'rms_300_1000_um': '300-1000 mm',
}


def box_title(name: str) -> str:
    """``axle1_left`` -> ``axle 1 left``: the name of an axle box as a reader would write it."""
    words = name.replace('_', ' ')
    return ''.join(
        f' {c}' if c.isdigit() and i and words[i - 1].isalpha() else c
        for i, c in enumerate(words)
    )
