"""The estimator from one recording to another: the whole run, or a part of it with its warm-up."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from railtrack_ros.bags.codec import Status, encode_diagnostics
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import (
    AccelerationBlock,
    Defect,
    PositionSample,
    Run,
    SpeedSample,
)
from railtrack_ros.bags.writer import FRAME, Recording
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Estimator, Health
from railtrack_ros.estimation.indicators import Way
from railtrack_ros.estimation.odometer import Odometer
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.estimation.timeline import SampleClock
from railtrack_ros.runs import configuration
from railtrack_ros.runs.estimated import Estimated
from railtrack_ros.runs.remarks import Remarks, told
from railtrack_ros.runs.results import (
    CONFIGURATION,
    FinishedSections,
    ResultMessages,
    section_messages,
    waveforms,
)
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

NODE = '/track_estimator'
DIAGNOSTICS_TOPIC = '/diagnostics'


@dataclass(frozen=True)
class Case:
    """What an estimate depends on besides the data."""

    track: Track
    vehicle: Vehicle
    settings: EstimatorSettings
    indicators: IndicatorSettings

    def topics(self, run: Run) -> dict[str, str]:
        """Return the types of all topics of the output by name."""
        copied = {name: x.type for name, x in run.bag.topics.items() if not is_result(name, run)}
        topics = ResultMessages.topics(self.vehicle, self.indicators)
        results = {CONFIGURATION: configuration.TYPE, **topics}
        named = {f'{NODE}/{name}': kind for name, kind in results.items()}
        diagnostics = encode_diagnostics(0, [], OFFLINE).__msgtype__
        return {**copied, **named, DIAGNOSTICS_TOPIC: copied.get(DIAGNOSTICS_TOPIC, diagnostics)}

    def facts(self, run: Run) -> dict[str, Any]:
        """Return the facts of the output."""
        return {**run.bag.facts, 'start_position': self.settings.start_position,
                'track': self.track.name, 'vehicle': self.vehicle.name}

    def begin(self, recording: Recording, run: Run) -> None:
        """Write what stands before all results."""
        recording.write_facts(self.facts(run))
        text = configuration.write_configuration(
            self.track, self.vehicle, self.settings, self.indicators)
        message = OFFLINE.get(configuration.TYPE)(data=text)
        recording.write(f'{NODE}/{CONFIGURATION}', message, run.bag.start_time)


@dataclass
class Start:
    """Where a run is at some time: clock, way, way of the sections, when forces were told last."""

    clock: SampleClock
    odometer: Odometer
    sections: Way
    forces_told_ns: int


@dataclass(frozen=True)
class Part:
    """A part of a run by log times [ns]; None: from its beginning, to its end.

    Messages from `since` on are read, and what belongs to those from `begin` on is given; what
    lies between is the warm-up.
    """

    since: int | None = None
    begin: int | None = None
    until: int | None = None
    start: Start | None = None


WHOLE = Part()


@dataclass
class PartFound:
    """What the pipeline found in a part.

    health: counts in this part. sections: those finished, with the log time of the block that
    finished them.
    """

    found: Estimated
    health: Health = field(default_factory=Health)
    channels: set[str] = field(default_factory=set)
    remarks: Remarks = field(default_factory=Remarks)
    sections: list[tuple[int, FinishedSections]] = field(default_factory=list)
    last_log_time: int = 0

    def join(self, later: PartFound) -> None:
        """Take what was found in a later part."""
        self.found.join(later.found)
        self.health = sum_of(self.health, later.health)
        self.channels |= later.channels
        self.remarks.join(later.remarks)
        self.last_log_time = later.last_log_time


class _Resumed(Estimator):
    """An estimator that begins within a run."""

    def resume(self, start: Start) -> None:
        """Go on at the time and the place of a start."""
        self._clock, self._odometer = start.clock, start.odometer


class Pipeline:
    """One part of a run from recording to recording.

    Parameters
    ----------
    separate
        Leave the messages about sections to whoever joins the parts.
    """

    def __init__(self, run: Run, recording: Recording, case: Case, part: Part = WHOLE,
                 separate: bool = False) -> None:
        self.result = PartFound(Estimated(case.settings), last_log_time=run.bag.start_time)
        self._run, self._recording, self._part = run, recording, part
        self._separate = separate
        self._estimator = _Resumed(case.track, case.vehicle, case.settings, test_model=False)
        self._results = ResultMessages(case.vehicle, OFFLINE, case.indicators, case.settings)
        self._warm = part.begin is None
        self._before = Health()
        if part.start is not None:
            self._estimator.resume(part.start)
            self._results.resume(part.start.sections, part.start.forces_told_ns)

    def steps(self) -> Iterator[int]:
        """Do the work; yields the log time of every message.

        A block waits until every message of the same log time has been seen.
        """
        waiting: list[AccelerationBlock] = []
        for event in self._run.events(self._part.since, self._part.until):
            message = event.message
            while waiting and message.log_time > waiting[0].message.log_time:
                self._block(waiting.pop(0))
            if not self._warm and message.log_time >= (self._part.begin or 0):
                self._end_warm_up()
            copied = not (isinstance(event, AccelerationBlock) and event.gathered)
            if self._warm and copied and not is_result(message.topic, self._run):
                self._recording.write_raw(
                    message.topic, message.type, message.log_time, message.data
                )
            if isinstance(event, AccelerationBlock):
                waiting.append(event)
            elif isinstance(event, SpeedSample):
                self._estimator.add_speed(event.stamp_ns, event.speed)
            elif isinstance(event, PositionSample):
                self._estimator.set_position(event.stamp_ns, event.position)
            elif isinstance(event, Defect) and self._warm:
                self.result.remarks.defects.append(event.reason)
            yield message.log_time
        for block in waiting:
            self._block(block)
        if self._part.until is None:
            self._results.end()
            self._take_sections()
        self.result.health = difference(self._estimator.health, self._before)

    def _end_warm_up(self) -> None:
        self._warm = True
        self._estimator.take_notes()
        self._before = self._estimator.health

    def _block(self, event: AccelerationBlock) -> None:
        block, result = event.block, self.result
        result.last_log_time = event.message.log_time
        estimate = self._estimator.process(block.stamp_ns, block.t, block.channels)
        if self._warm:
            result.channels.update(block.channels)
            seconds = (result.last_log_time - self._run.bag.start_time) / 1e9
            for note in self._estimator.take_notes():
                result.remarks.note(note, f'at {seconds:.3f} s: ')
        if estimate is None:
            return
        frame_id = block.frame_id or FRAME
        forces = list(self._results.forces(estimate, frame_id))
        if self._warm:
            result.found.add(estimate, self._estimator.time_step or 0.0)
            for topic, waveform in waveforms(estimate, frame_id):
                self._recording.write_waveform(
                    f'{NODE}/{topic}', waveform, result.last_log_time)
            self._write(forces)
        self._results.feed(estimate)
        self._take_sections()

    def _take_sections(self) -> None:
        finished = self._results.finished
        if not finished.sections or not self._warm:
            return
        self.result.sections.append((self.result.last_log_time, finished))
        if not self._separate:
            self.result.found.sections += finished.sections
            self._write(section_messages(finished, OFFLINE))

    def _write(self, results: Iterable[tuple[str, Any]]) -> None:
        for topic, message in results:
            self._recording.write(f'{NODE}/{topic}', message, self.result.last_log_time)


def is_result(topic: str, run: Run) -> bool:
    """Return whether a topic of a recording holds earlier results."""
    return topic.startswith(f'{NODE}/') and topic != run.position_topic


def difference(health: Health, before: Health) -> Health:
    """Return the counts since an earlier state of health, and how things stand now."""
    return _combined(health, before, -1)


def sum_of(health: Health, later: Health) -> Health:
    """Return the counts of two parts together, and how things stand after the later one."""
    return _combined(later, health, 1)


def _combined(health: Health, other: Health, sign: int) -> Health:
    values: dict[str, Any] = {}
    for name, value in vars(health).items():
        there = getattr(other, name)
        if isinstance(value, int) and not isinstance(value, bool):
            value += sign * there
        elif isinstance(value, dict):
            value = {key: count + sign * there.get(key, 0) for key, count in value.items()}
        values[name] = value
    return Health(**values)


def conclude(result: PartFound, run: Run, recording: Recording, vehicle: Vehicle) -> Estimated:
    """Sum up the whole run, write its diagnostics, and refuse one that gave nothing.

    Raises
    ------
    InputError
        Not a single sample could be estimated.
    """
    found = result.found
    found.sample_rate = result.health.sample_rate
    found.extra_channels = tuple(sorted(result.channels - set(found.boxes)))
    _refuse_nothing(result, run, vehicle)
    found.defects = told([*run.bag.notes, *result.remarks.defects], run.bag.path)
    found.remarks = told(result.remarks.remarks, run.bag.path)
    time = result.last_log_time
    statuses = _statuses(result, vehicle)
    recording.write(DIAGNOSTICS_TOPIC, encode_diagnostics(time, statuses, OFFLINE), time)
    return found


def _refuse_nothing(result: PartFound, run: Run, vehicle: Vehicle) -> None:
    """Raise an InputError where not a single sample could be estimated."""
    path, found, settings = run.bag.path, result.found, result.found.settings
    boxes = [box.name for box in vehicle.axle_boxes]
    topic = run.acceleration_topic
    remarks = result.remarks.all()
    because = f' ({remarks[0]})' if remarks else ''
    if not result.channels:
        raise InputError(f'{path}: {topic} holds no block that can be read{because}')
    if not result.channels.intersection(boxes):
        raise InputError(
            f'{path}: {topic} has the channels {", ".join(sorted(result.channels))}, none of '
            f'the axle boxes of vehicle {vehicle.name}: {", ".join(boxes)}'
        )
    if not result.health.blocks:
        because = because or ' (fewer than 33 samples, one a block, do not tell the sample rate)'
        raise InputError(f'{path}: no block of {topic} could be used{because}')
    if not found.duration:
        raise InputError(
            f'{path}: {run.speed_topic} gives no speed at the time of the acceleration{because}'
        )
    if found.highest_speed < settings.minimum_speed:
        raise InputError(
            f'{path}: {run.speed_topic} is never above {found.highest_speed:.3g} m/s: '
            'a vehicle that stands still cannot be estimated '
            f'(minimum_speed is {settings.minimum_speed:g} m/s)'
        )
    if not any(box.valid for box in found.boxes.values()):
        raise InputError(
            f'{path}: no valid sample in {found.distance:.1f} m: estimates begin after '
            f'{2.0 * settings.cut_on_wavelength:g} m (two cut-on wavelengths) and 0.1 s '
            f'without a gap{because}'
        )


def _statuses(result: PartFound, vehicle: Vehicle) -> list[Status]:
    """Health of the inputs over the whole recording."""
    health = result.health
    node = NODE.removeprefix('/')
    values = {
        name: str(value)
        for name, value in vars(health).items()
        if isinstance(value, (int, float, str))
    }
    remarks = result.remarks.all()
    count = len(remarks)
    remark = f'{count} remarks, first: {remarks[0]}' if count else 'no defects'
    statuses = [Status(int(count > 0), f'{node}: recording', remark, '', values)]
    dead = _dead(health)
    for axle_box in vehicle.axle_boxes:
        name = axle_box.name
        box = result.found.boxes[name]
        bad = health.bad_samples[name]
        message = f'{100.0 * box.valid / max(box.samples, 1):.1f} % of the samples are valid'
        others = [other.name for other in vehicle.on_rail(axle_box.rail)
                  if other.name in dead and other.name != name]
        if others:
            message += (f'; {", ".join(others)} on the same rail is dead, all the time or at '
                        'times: its part of the rail deflection is the static one only then')
        level = 2 if not box.valid else int(bad > 0 or bool(others))
        statuses.append(
            Status(
                level, f'{node}: axle box {name}', message, vehicle.name,
                {'valid_samples': str(box.valid), 'bad_samples': str(bad),
                 'blocks_without_channel': str(health.missing_blocks[name])},
            )  # fmt: skip
        )
    return statuses


def _dead(health: Health) -> set[str]:
    """Return the axle boxes that missed at least as many samples as a block has."""
    block = health.samples / max(health.blocks, 1)
    return {name for name, bad in health.bad_samples.items() if bad >= max(block, 1.0)}
