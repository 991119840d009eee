"""The messages of the estimator's results: the same from the live node and in recordings.

Topics are relative to the node, `~/TOPIC`. The waveforms of a block come first, so that nothing
delays them; then, for each axle box, the largest contact force every 0.1 s and the indicators of
the sections that it has left.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, Status, WaveformBlock
from railtrack_ros.bags.message_types import MessageTypes
from railtrack_ros.estimation.estimator import EstimateBlock
from railtrack_ros.estimation.indicators import BANDS, Section, SectionIndicators, band_name
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
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
    def topics(vehicle: Vehicle) -> dict[str, str]:
        """Return the message types of all topics with results."""
        topics = dict.fromkeys(WAVEFORMS, codec.WAVEFORM)
        topics[CORRUGATION] = codec.DIAGNOSTICS
        for box in vehicle.axle_boxes:
            topics[f'wheel/{box.name}/contact_force'] = codec.WRENCH
            for band in BANDS:
                topics[f'wheel/{box.name}/rms_{band_name(band)}'] = codec.FLOAT64
        return topics

    def block(self, estimate: EstimateBlock, frame_id: str) -> Messages:
        """Yield the messages of a block with their topics; all of them have to be taken."""
        for name in WAVEFORMS:
            channels = getattr(estimate, name)
            block = WaveformBlock(
                estimate.stamp_ns, estimate.t, channels, estimate.position, frame_id
            )
            yield name, codec.encode_waveform(block, self._types)
        self._frame_id = frame_id
        self._end_ns = estimate.stamp_ns + round(float(estimate.t[-1]) * SECOND)
        yield from self._forces(estimate)
        self.sections = self._indicators.feed(
            estimate.t, estimate.position, estimate.irregularity
        )
        yield from self._corrugation()

    def finish(self) -> Messages:
        """Yield the messages of the sections under way at the end of a run."""
        self.sections = self._indicators.finish()
        yield from self._corrugation()

    def _forces(self, estimate: EstimateBlock) -> Messages:
        for name, force in estimate.contact_force.items():
            peak = float(np.fmax.reduce(force))
            if np.isfinite(peak):
                self._peaks[name] = max(self._peaks.get(name, peak), peak)
        if 0 <= self._end_ns - self._last_force_ns < FORCE_PERIOD:
            return
        peaks, self._peaks, self._last_force_ns = self._peaks, {}, self._end_ns
        for name, peak in peaks.items():
            message = codec.encode_force(self._end_ns, peak, self._frame_id, self._types)
            yield f'wheel/{name}/contact_force', message

    def _corrugation(self) -> Messages:
        if not self.sections:
            return
        statuses = [self._status(section) for section in self.sections]
        yield (
            CORRUGATION,
            codec.encode_diagnostics(self._end_ns, statuses, self._types, self._frame_id),
        )
        for section in self.sections:
            for band, rms in zip(BANDS, section.rms, strict=True):
                if np.isfinite(rms):
                    topic = f'wheel/{section.axle_box}/rms_{band_name(band)}'
                    yield topic, codec.encode_number(1e6 * rms, self._types)

    def _status(self, section: Section) -> Status:
        values = {
            name: '' if value is None else str(value) for name, value in section.row().items()
        }
        name = f'corrugation: {section.axle_box}'
        return Status(0, name, describe(section), self._vehicle.name, values)


def describe(section: Section) -> str:
    """Return what a section shows, in a few words."""
    place = f'{section.start:g} to {section.end:g} m'
    if np.isfinite(section.dominant_wavelength):
        return (
            f'{place}: {1e3 * section.dominant_wavelength:.0f} mm stands out, '
            f'{1e6 * section.dominant_rms:.1f} um RMS'
        )
    return f'{place}: no wavelength stands out'
