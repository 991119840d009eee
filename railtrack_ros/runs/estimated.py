"""What an estimate over a recording has found, in figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from railtrack_ros.estimation.estimator import EstimateBlock
from railtrack_ros.estimation.indicators import Section
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.runs.results import describe


@dataclass
class BoxFigures:
    """What an axle box has given: samples, those valid, and the extremes of the force [N]."""

    samples: int = 0
    valid: int = 0
    lowest_force: float = math.inf
    highest_force: float = -math.inf

    def join(self, later: BoxFigures) -> None:
        """Take what a later block or part of the run has given."""
        self.samples += later.samples
        self.valid += later.valid
        self.lowest_force = min(self.lowest_force, later.lowest_force)
        self.highest_force = max(self.highest_force, later.highest_force)


@dataclass
class Estimated:
    """What was found in a recording.

    Attributes
    ----------
    duration, distance
        Time [s] and way [m] that were estimated over, gaps left out.
    start, end
        Track positions [m] at the first and the last sample with a position.
    lowest_speed, highest_speed
        Magnitudes [m/s].
    boxes, sections
        By axle box, and all sections that were finished.
    extra_channels
        Channels that are no axle box.
    defects
        What was wrong with the input, a line each.
    remarks
        What happened that belongs to normal operation, such as gaps, a line each.
    """

    settings: EstimatorSettings
    sample_rate: float = math.nan
    duration: float = 0.0
    distance: float = 0.0
    start: float = math.nan
    end: float = math.nan
    lowest_speed: float = math.inf
    highest_speed: float = 0.0
    boxes: dict[str, BoxFigures] = field(default_factory=dict)
    sections: list[Section] = field(default_factory=list)
    extra_channels: tuple[str, ...] = ()
    defects: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def add(self, block: EstimateBlock, step: float) -> None:
        """Take a block."""
        forces = np.array(list(block.contact_force.values()))
        blocks = zip(
            block.contact_force, np.count_nonzero(np.isfinite(forces), axis=1).tolist(),
            np.fmin.reduce(forces, axis=1, initial=math.inf).tolist(),
            np.fmax.reduce(forces, axis=1, initial=-math.inf).tolist(), strict=True)
        for name, valid, lowest, highest in blocks:
            self.boxes.setdefault(name, BoxFigures()).join(
                BoxFigures(forces.shape[1], valid, lowest, highest))
        if np.isnan(block.position[0]):
            return
        speed = np.abs(block.speed)
        self.duration += speed.size * step
        self.distance += float(speed.sum()) * step
        self.start = float(block.position[0]) if math.isnan(self.start) else self.start
        self.end = float(block.position[-1])
        self.lowest_speed = min(self.lowest_speed, float(speed.min()))
        self.highest_speed = max(self.highest_speed, float(speed.max()))

    def join(self, later: Estimated) -> None:
        """Take what was found in a later part of the run."""
        for name, box in later.boxes.items():
            self.boxes.setdefault(name, BoxFigures()).join(box)
        self.duration += later.duration
        self.distance += later.distance
        self.start = later.start if math.isnan(self.start) else self.start
        self.end = self.end if math.isnan(later.end) else later.end
        self.lowest_speed = min(self.lowest_speed, later.lowest_speed)
        self.highest_speed = max(self.highest_speed, later.highest_speed)
        self.sections += later.sections

    @property
    def worst(self) -> Section | None:
        """The section with the most prominent wavelength, else with the largest 30-100 mm RMS."""
        named = [s for s in self.sections if math.isfinite(s.dominant_wavelength)]
        if named:
            return max(named, key=lambda s: s.dominant_above_limit)
        resolved = [s for s in self.sections if math.isfinite(s.rms[1])]
        return max(resolved, key=lambda s: s.rms[1], default=None)

    def summary(self) -> dict[str, Any]:
        """Return the figures under machine-readable names."""
        return {
            'duration_s': self.duration,
            'distance_m': self.distance,
            'start_m': self.start,
            'end_m': self.end,
            'lowest_speed_m_s': self.lowest_speed,
            'highest_speed_m_s': self.highest_speed,
            'sample_rate_hz': self.sample_rate,
            'axle_boxes': {
                name: {
                    'valid_fraction': box.valid / max(box.samples, 1),
                    'lowest_force_n': box.lowest_force,
                    'highest_force_n': box.highest_force,
                }
                for name, box in self.boxes.items()
            },
            'sections': len(self.sections),
            'worst_section': self.worst.row() if self.worst else None,
            'extra_channels': list(self.extra_channels),
            'defects': self.defects,
            'remarks': self.remarks,
        }

    def lines(self) -> list[str]:
        """Return the figures for people."""
        lines = [
            f'{self.duration:.2f} s, {self.distance:.1f} m from {self.start:.1f} m to '
            f'{self.end:.1f} m at {self.lowest_speed:.4g} to {self.highest_speed:.4g} m/s '
            f'({3.6 * self.highest_speed:.4g} km/h), {len(self.boxes)} axle boxes at '
            f'{self.sample_rate:.6g} Hz'
        ]
        forces = [box for box in self.boxes.values() if box.valid]
        lines.append(
            f'contact force {1e-3 * min(box.lowest_force for box in forces):.1f} to '
            f'{1e-3 * max(box.highest_force for box in forces):.1f} kN'
        )
        if self.worst:
            lines.append(
                f'{len(self.sections)} sections; {self.worst.axle_box}, {describe(self.worst)}'
            )
        if self.extra_channels:
            lines.append(f'channels that are no axle box: {", ".join(self.extra_channels)}')
        return lines
