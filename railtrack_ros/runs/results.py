"""The messages of the estimator's results: the same from the live node and in recordings.

Topics are relative to the node, `~/TOPIC`. The waveforms of a block come first, so that nothing
delays them; then, for each axle box, the largest contact force every 0.1 s and the indicators of
the sections that it has left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, Status, WaveformBlock
from railtrack_ros.bags.message_types import MessageTypes
from railtrack_ros.estimation.estimator import EstimateBlock
from railtrack_ros.estimation.indicators import Section, SectionIndicators, Way, band_name
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.output import metres
from railtrack_ros.vehicle.description import Vehicle

WAVEFORMS = ('contact_force', 'rail_deflection', 'irregularity')
CORRUGATION = 'corrugation'
CONFIGURATION = 'configuration'

# Time between two summaries of the contact force [ns].
FORCE_PERIOD = SECOND // 10

Messages = Iterator[tuple[str, Any]]


class ResultMessages:
    """Turns estimates into messages, block by block.

    Parameters
    ----------
    vehicle
        Its axle boxes.
    types
        Where the message classes come from (:mod:`railtrack_ros.bags.message_types`).
    indicators, estimator
        How sections are made, and what the estimate could resolve.

    Attributes
    ----------
    sections
        Those finished by the last block or by `finish`.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        types: MessageTypes,
        indicators: IndicatorSettings | None = None,
        estimator: EstimatorSettings | None = None,
    ) -> None:
        self.sections: list[Section] = []
        self._vehicle = vehicle
        self._types = types
        self._indicators = SectionIndicators(vehicle, indicators, estimator)
        self._peaks: dict[str, float] = {}
        self._last_force_ns = -(2**62)
        self._end_ns = 0
        self._frame_id = ''

    @staticmethod
    def topics(vehicle: Vehicle, indicators: IndicatorSettings | None = None) -> dict[str, str]:
        """Return the message types of all topics with results."""
        topics = dict.fromkeys(WAVEFORMS, codec.WAVEFORM)
        topics[CORRUGATION] = codec.DIAGNOSTICS
        for box in vehicle.axle_boxes:
            topics[f'wheel/{box.name}/contact_force'] = codec.WRENCH
            for band in (indicators or IndicatorSettings()).wavelengths:
                topics[f'wheel/{box.name}/rms_{band_name(band)}'] = codec.FLOAT64
        return topics

    def block(self, estimate: EstimateBlock, frame_id: str) -> Messages:
        """Yield the messages of a block with their topics; all of them have to be taken."""
        for name, waveform in waveforms(estimate, frame_id):
            yield name, codec.encode_waveform(waveform, self._types)
        yield from self.forces(estimate, frame_id)
        self.feed(estimate)
        yield from self._corrugation()

    def forces(self, estimate: EstimateBlock, frame_id: str) -> Messages:
        """Yield the summaries of the contact force that are due after a block."""
        self._frame_id = frame_id
        self._end_ns = estimate.stamp_ns + round(float(estimate.t[-1]) * SECOND)
        peaks = np.fmax.reduce(np.array(list(estimate.contact_force.values())), axis=1)
        for name, peak in zip(estimate.contact_force, peaks.tolist(), strict=True):
            if math.isfinite(peak):
                self._peaks[name] = max(self._peaks.get(name, peak), peak)
        if not forces_are_due(self._last_force_ns, self._end_ns):
            return
        told, self._peaks, self._last_force_ns = self._peaks, {}, self._end_ns
        for name, peak in told.items():
            message = codec.encode_force(self._end_ns, peak, self._frame_id, self._types)
            yield f'wheel/{name}/contact_force', message

    def feed(self, estimate: EstimateBlock) -> None:
        """Take a block, whose waveforms are told, into the sections."""
        self.sections = self._indicators.feed(
            estimate.t, estimate.position, estimate.irregularity, estimate.stamp_ns
        )

    def finish(self) -> Messages:
        """Yield the messages of the sections under way at the end of a run."""
        self.end()
        yield from self._corrugation()

    def end(self) -> None:
        """Finish the sections under way at the end of a run."""
        self.sections = self._indicators.finish()

    def resume(self, way: Way, forces_told_ns: int) -> None:
        """Go on within a run: where its sections are, and when forces were summed up last [ns]."""
        self._indicators.resume(way)
        self._last_force_ns = forces_told_ns

    @property
    def finished(self) -> FinishedSections:
        """Return the sections of the last block with what their messages need."""
        return FinishedSections(self.sections, self._end_ns, self._frame_id, self._vehicle.name)

    def _corrugation(self) -> Messages:
        return section_messages(self.finished, self._types)


def waveforms(estimate: EstimateBlock, frame_id: str) -> Iterator[tuple[str, WaveformBlock]]:
    """Yield the waveforms of a block with their topics."""
    for name in WAVEFORMS:
        yield name, WaveformBlock(
            estimate.stamp_ns, estimate.t, getattr(estimate, name), estimate.position, frame_id)


@dataclass(frozen=True)
class FinishedSections:
    """Sections that a block has finished: time of its last sample [ns], its frame, the vehicle."""

    sections: list[Section]
    stamp_ns: int
    frame_id: str
    vehicle: str


def section_messages(finished: FinishedSections, types: MessageTypes) -> Messages:
    """Yield the messages that tell of finished sections with their topics."""
    if not finished.sections:
        return
    statuses = []
    for section in finished.sections:
        values = {
            name: '' if value is None else str(value) for name, value in section.row().items()
        }
        name = f'corrugation: {section.axle_box}'
        statuses.append(Status(section.level, name, describe(section), finished.vehicle, values))
    yield (
        CORRUGATION,
        codec.encode_diagnostics(finished.stamp_ns, statuses, types, finished.frame_id),
    )
    for section in finished.sections:
        for band, rms in zip(section.bands, section.rms, strict=True):
            if np.isfinite(rms):
                topic = f'wheel/{section.axle_box}/rms_{band_name(band)}'
                yield topic, codec.encode_number(1e6 * rms, types)


def forces_are_due(told_ns: int, end_ns: int) -> bool:
    """Tell whether a block that ends at a time [ns] sums up the contact forces."""
    return not 0 <= end_ns - told_ns < FORCE_PERIOD


def describe(section: Section) -> str:
    """Return what a section shows, in a few words."""
    where = f'{metres(section.start)} to {metres(section.end)} m'
    text = f'{where}: no wavelength stands out'
    if np.isfinite(section.dominant_wavelength):
        text = (
            f'{where}: {1e3 * section.dominant_wavelength:.0f} mm stands out, '
            f'{1e6 * section.dominant_rms:.1f} um RMS'
        )
    return f'{text}; {section.reason}' if section.reason else text
