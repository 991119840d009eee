"""What a figure consists of: curves with their axes, and what they say about the thesis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Limits = tuple[float, float] | None

AGREES = 'agrees'
DIFFERS = 'differs'
MISPRINT = 'misprint in the thesis'
UNKNOWN = 'the thesis does not say'


@dataclass(frozen=True)
class Curve:
    """Values (n,) over the panel's x; `name` is the column of the CSV."""

    name: str
    label: str
    values: NDArray[Any]
    line: str = '-'


@dataclass(frozen=True)
class Panel:
    """One pair of axes; all curves share x (n,).

    supports: places [in the unit of x] that are marked on the x axis; inset: (xlim, ylim) of an
    enlarged part; name: appended to the name of the CSV where a figure has several panels.
    """

    x_name: str
    x_label: str
    y_label: str
    x: Array
    curves: tuple[Curve, ...]
    x_limits: Limits = None
    y_limits: Limits = None
    logarithmic: bool = False
    supports: tuple[float, ...] = ()
    inset: tuple[tuple[float, float], tuple[float, float]] | None = None
    title: str = ''
    name: str = ''

    def columns(self) -> dict[str, Array]:
        """Return the columns of the CSV."""
        return {self.x_name: self.x, **{curve.name: curve.values for curve in self.curves}}


@dataclass(frozen=True)
class Surface:
    """A function z (len(y), len(x)) of two variables."""

    names: tuple[str, str, str]
    labels: tuple[str, str, str]
    x: Array
    y: Array
    z: Array
    name: str = ''

    def columns(self) -> dict[str, Array]:
        """Return the columns of the CSV, one row a point."""
        x, y = np.meshgrid(self.x, self.y)
        return dict(zip(self.names, (x.ravel(), y.ravel(), self.z.ravel()), strict=True))


@dataclass(frozen=True)
class Finding:
    """What the thesis shows or claims, what is computed here, and how the two compare."""

    thesis: str
    computed: str
    verdict: str


@dataclass(frozen=True)
class Figure:
    """A figure ready to be drawn; `conditions` tells all that the computation was given."""

    conditions: str
    panels: tuple[Panel | Surface, ...]
    findings: tuple[Finding, ...]
    columns: int = 1


@dataclass(frozen=True)
class Entry:
    """A figure of the thesis by its number: what it shows and how it is computed."""

    number: str
    title: str
    compute: Callable[[], Figure]

    @property
    def stem(self) -> str:
        """File name without its suffix."""
        return 'figure_' + self.number.replace('.', '_')
