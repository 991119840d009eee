"""Which mechanism fixes the wavelength of corrugation: the classes of thesis table 1.1.

Corrugation grows at a frequency, that of a resonance of vehicle and track; the wavelength is the
speed of the traffic over it. So the class follows from the wavelength, from the speeds that the
line is run at (not the speed of the measurement) and from this track's own resonances. Where two
of them answer, the case is ambiguous and is said to be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# How far around its resonance a mechanism is taken to act: factors on the frequency. P2 is broad;
# the pinned-pinned resonance sharp, but different wheels and supports move it.
P2_WIDTH = (0.75, 1.3)
SLEEPER_WIDTH = (0.85, 1.15)
PINNED_WIDTH = (0.85, 1.12)

# Second torsion of the axle [Hz]: not in a model of the vertical dynamics, from table 1.1.
TORSION = (250.0, 400.0)

# A wavelength this close to the sleeper spacing is a deflection between the sleepers.
SPACING_MARGIN = 0.05

P2 = 'P2 resonance (heavy haul, light rail or other P2)'
SLEEPER = 'sleeper resonance (trackform specific)'
RUTTING = 'second torsion of the axle (rutting)'
PINNED = 'pinned-pinned resonance (roaring rails)'
SPACING = 'sleeper spacing (deflection between sleepers, not corrugation)'


@dataclass(frozen=True)
class TrackFrequencies:
    """Resonances of this track under this vehicle [Hz], empty where there is none.

    p2: of the unsprung mass on the track; sleeper: of the sleepers, in phase and out of phase with
    the rail; pinned: of the rail between the sleepers. spacing of the sleepers [m].
    """

    p2: tuple[float, ...]
    sleeper: tuple[float, ...]
    pinned: tuple[float, ...]
    spacing: float


@dataclass(frozen=True)
class Mechanism:
    """Candidates for a wavelength, the nearest first, and the frequencies [Hz] it stands for.

    certainty: 'clear' (one mechanism, all speeds inside it), 'likely' (one, some speeds outside),
    'ambiguous' (several), 'none' (no mechanism known at these frequencies).
    """

    candidates: tuple[str, ...]
    certainty: str
    lowest: float
    highest: float

    def __str__(self) -> str:
        if not self.candidates:
            return f'none known at {self._frequencies()}'
        text = ' or '.join(self.candidates)
        return f'{self.certainty}: {text}, {self._frequencies()}'

    def _frequencies(self) -> str:
        if self.highest < 1.02 * self.lowest:
            return f'{0.5 * (self.lowest + self.highest):.0f} Hz'
        return f'{self.lowest:.0f}-{self.highest:.0f} Hz'


def classify(wavelength: float, speeds: tuple[float, float], track: TrackFrequencies) -> Mechanism:
    """Return the mechanism of a wavelength [m] at the slowest and fastest line speed [m/s]."""
    lowest, highest = speeds[0] / wavelength, speeds[1] / wavelength
    ranges: list[tuple[str, float, float]] = []
    for name, centres, width in ((P2, track.p2, P2_WIDTH), (SLEEPER, track.sleeper, SLEEPER_WIDTH),
                                 (PINNED, track.pinned, PINNED_WIDTH)):  # fmt: skip
        ranges += [(name, width[0] * f, width[1] * f) for f in centres]
    ranges.append((RUTTING, *TORSION))
    middle = math.sqrt(lowest * highest)
    near = [item for item in ranges if item[1] <= highest and lowest <= item[2]]
    near.sort(key=lambda item: abs(math.log(middle / math.sqrt(item[1] * item[2]))))
    candidates = tuple(dict.fromkeys(name for name, _, _ in near))
    if abs(wavelength / track.spacing - 1.0) <= SPACING_MARGIN:
        candidates = (SPACING, *candidates)
    if len(candidates) > 1:
        certainty = 'ambiguous'
    elif not candidates:
        certainty = 'none'
    elif candidates[0] == SPACING or any(a <= lowest and highest <= b for _, a, b in near):
        certainty = 'clear'
    else:
        certainty = 'likely'
    return Mechanism(candidates, certainty, lowest, highest)
