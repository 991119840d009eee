"""The estimator over a recording: inputs and results into a new one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from railtrack_ros.bags.codec import Status, encode_diagnostics
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import (
    AccelerationBlock,
    Defect,
    PositionSample,
    Run,
    SpeedSample,
    read_run,
)
from railtrack_ros.bags.writer import FRAME, Recording
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import EstimateBlock, Estimator
from railtrack_ros.estimation.indicators import Section
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.runs import configuration
from railtrack_ros.runs.results import CONFIGURATION, ResultMessages, describe
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

NODE = '/track_estimator'
DIAGNOSTICS_TOPIC = '/diagnostics'

# Defects that are told one by one.
MOST_DEFECTS = 12


@dataclass
class BoxFigures:
    """What an axle box has given: samples, those valid, and the extremes of the force [N]."""

    samples: int = 0
    valid: int = 0
    lowest_force: float = math.inf
    highest_force: float = -math.inf

    def add(self, force: np.ndarray) -> None:
        """Take the forces (n,) of a block."""
        valid = force[np.isfinite(force)]
        self.samples += force.size
        self.valid += valid.size
        if valid.size:
            self.lowest_force = min(self.lowest_force, float(valid.min()))
            self.highest_force = max(self.highest_force, float(valid.max()))


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

    def add(self, block: EstimateBlock, step: float) -> None:
        """Take a block."""
        for name, force in block.contact_force.items():
            self.boxes.setdefault(name, BoxFigures()).add(force)
        if np.isnan(block.position[0]):
            return
        speed = np.abs(block.speed)
        self.duration += speed.size * step
        self.distance += float(speed.sum()) * step
        self.start = float(block.position[0]) if math.isnan(self.start) else self.start
        self.end = float(block.position[-1])
        self.lowest_speed = min(self.lowest_speed, float(speed.min()))
        self.highest_speed = max(self.highest_speed, float(speed.max()))

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


def estimate(
    bag: str | Path,
    track: Track,
    vehicle: Vehicle,
    output: str | Path,
    settings: EstimatorSettings | None = None,
    indicators: IndicatorSettings | None = None,
    start_position: float | None = None,
    acceleration_topic: str | None = None,
    speed_topic: str | None = None,
    progress: Callable[[float, float], None] = lambda done, total: None,
) -> Estimated:
    """Run the estimator over a recording and write inputs and results to another.

    Every message of the recording is copied but for earlier results of an estimator; the results
    are logged at the time of the block that they belong to.

    Parameters
    ----------
    bag, output
        Recordings: a rosbag2 folder or an `.mcap` file.
    settings, indicators
        Those of the estimator and of the sections.
    start_position
        Track position at the first sample [m]; None: as the recording tells, else the setting.
    acceleration_topic, speed_topic
        Input topics, None for the usual ones.
    progress
        Called with the seconds that are done, and all of them.

    Raises
    ------
    InputError
        Nothing can be estimated: no inputs, no axle box of the vehicle among the channels, no
        speed, standstill all the time, or a run too short to settle.
    """
    with (
        read_run(bag, acceleration_topic, speed_topic, everything=True) as run,
        Recording(output, inputs=[bag]) as recording,
    ):
        settings = settings or EstimatorSettings()
        if start_position is None:
            start_position = run.start_position
        if start_position is not None:
            settings = replace(settings, start_position=start_position)
        pipeline = _Pipeline(run, recording, track, vehicle, settings, indicators)
        seconds = (run.bag.end_time - run.bag.start_time) / 1e9
        for time_ns in pipeline.steps():
            progress((time_ns - run.bag.start_time) / 1e9, seconds)
        return pipeline.found


class _Pipeline:
    """One run from recording to recording."""

    def __init__(
        self,
        run: Run,
        recording: Recording,
        track: Track,
        vehicle: Vehicle,
        settings: EstimatorSettings,
        indicators: IndicatorSettings | None,
    ) -> None:
        self.found = Estimated(settings)
        self._run = run
        self._recording = recording
        self._vehicle = vehicle
        self._estimator = Estimator(track, vehicle, settings)
        indicators = indicators or IndicatorSettings()
        self._results = ResultMessages(vehicle, OFFLINE, indicators, settings)
        self._defects: list[str] = []
        self._channels: set[str] = set()
        self._log_time = run.bag.start_time
        recording.write_facts(
            {**run.bag.facts, 'start_position': settings.start_position, 'track': track.name,
             'vehicle': vehicle.name}
        )  # fmt: skip
        text = configuration.write_configuration(track, vehicle, settings, indicators)
        self._write([(CONFIGURATION, OFFLINE.get(configuration.TYPE)(data=text))])

    def steps(self) -> Iterator[int]:
        """Do the work; yields the log time of every message.

        A block waits until every message of the same log time has been seen.
        """
        waiting: list[AccelerationBlock] = []
        for event in self._run:
            message = event.message
            while waiting and message.log_time > waiting[0].message.log_time:
                self._block(waiting.pop(0))
            if not self._is_result(message.topic):
                self._recording.write_raw(
                    message.topic, message.type, message.log_time, message.data
                )
            if isinstance(event, AccelerationBlock):
                waiting.append(event)
            elif isinstance(event, SpeedSample):
                self._estimator.add_speed(event.stamp_ns, event.speed)
            elif isinstance(event, PositionSample):
                self._estimator.set_position(event.stamp_ns, event.position)
            elif isinstance(event, Defect):
                self._defects.append(event.reason)
            yield message.log_time
        for block in waiting:
            self._block(block)
        self._finish()

    def _is_result(self, topic: str) -> bool:
        return topic.startswith(f'{NODE}/') and topic != self._run.position_topic

    def _block(self, event: AccelerationBlock) -> None:
        block, self._log_time = event.block, event.message.log_time
        self._channels.update(block.channels)
        estimate = self._estimator.process(block.stamp_ns, block.t, block.channels)
        seconds = (self._log_time - self._run.bag.start_time) / 1e9
        self._defects += [f'at {seconds:.3f} s: {n}' for n in self._estimator.take_notes()]
        if estimate is None:
            return
        self.found.add(estimate, self._estimator.time_step or 0.0)
        self._write(self._results.block(estimate, block.frame_id or FRAME))
        self.found.sections += self._results.sections

    def _write(self, results: Iterable[tuple[str, Any]]) -> None:
        for topic, message in results:
            self._recording.write(f'{NODE}/{topic}', message, self._log_time)

    def _finish(self) -> None:
        self._write(self._results.finish())
        self.found.sections += self._results.sections
        health = self._estimator.health
        self.found.sample_rate = health.sample_rate
        self.found.extra_channels = tuple(sorted(self._channels - set(self.found.boxes)))
        self._refuse_nothing()
        defects = [*self._run.bag.notes, *self._defects]
        if len(defects) > MOST_DEFECTS:
            more = len(defects) - MOST_DEFECTS
            defects = [*defects[:MOST_DEFECTS], f'and {more} more remarks on the input']
        self.found.defects = [f'{self._run.bag.path}: {defect}' for defect in defects]
        self._recording.write(
            DIAGNOSTICS_TOPIC,
            encode_diagnostics(self._log_time, self._statuses(), OFFLINE),
            self._log_time,
        )

    def _refuse_nothing(self) -> None:
        """Raise an InputError where not a single sample could be estimated."""
        path, found, settings = self._run.bag.path, self.found, self.found.settings
        boxes = [box.name for box in self._vehicle.axle_boxes]
        topic, because = self._run.acceleration_topic, self._because()
        if not self._channels:
            raise InputError(f'{path}: {topic} holds no block that can be read{because}')
        if not self._channels.intersection(boxes):
            raise InputError(
                f'{path}: {topic} has the channels {", ".join(sorted(self._channels))}, none of '
                f'the axle boxes of vehicle {self._vehicle.name}: {", ".join(boxes)}'
            )
        if not found.duration:
            raise InputError(
                f'{path}: {self._run.speed_topic} gives no speed at the time of the '
                f'acceleration{because}'
            )
        if found.highest_speed < settings.minimum_speed:
            raise InputError(
                f'{path}: {self._run.speed_topic} is never above {found.highest_speed:.3g} m/s: '
                'a vehicle that stands still cannot be estimated '
                f'(minimum_speed is {settings.minimum_speed:g} m/s)'
            )
        if not any(box.valid for box in found.boxes.values()):
            raise InputError(
                f'{path}: no valid sample in {found.distance:.1f} m: estimates begin after '
                f'{2.0 * settings.cut_on_wavelength:g} m (two cut-on wavelengths) and 0.1 s '
                f'without a gap{because}'
            )

    def _because(self) -> str:
        return f' ({self._defects[0]})' if self._defects else ''

    def _statuses(self) -> list[Status]:
        """Health of the inputs over the whole recording."""
        health = self._estimator.health
        node = NODE.removeprefix('/')
        values = {
            name: str(value)
            for name, value in vars(health).items()
            if isinstance(value, (int, float, str))
        }
        count = len(self._defects)
        remark = f'{count} remarks, first: {self._defects[0]}' if count else 'no defects'
        statuses = [Status(int(count > 0), f'{node}: recording', remark, '', values)]
        for name, box in self.found.boxes.items():
            share = box.valid / max(box.samples, 1)
            bad = health.bad_samples[name]
            statuses.append(
                Status(
                    2 if not box.valid else int(bad > 0),
                    f'{node}: axle box {name}',
                    f'{100.0 * share:.1f} % of the samples are valid',
                    self._vehicle.name,
                    {'valid_samples': str(box.valid), 'bad_samples': str(bad),
                     'blocks_without_channel': str(health.missing_blocks[name])},
                )  # fmt: skip
            )
        return statuses
