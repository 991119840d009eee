"""`replay` from a recording to its results: estimate, drive the full model, compare, write."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from railtrack_ros.bags.bag import Bag, Paths, open_bag, paths_of
from railtrack_ros.bags.codec import SECOND, WAVEFORM, WaveformBlock
from railtrack_ros.bags.mcap_file import RawMessage
from railtrack_ros.bags.reader import (
    AccelerationBlock,
    Defect,
    OtherMessage,
    PositionSample,
    SpeedSample,
    read_run,
)
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.analysis import TrackAnalysis
from railtrack_ros.estimation.estimator import EstimateBlock, Estimator
from railtrack_ros.estimation.indicators import Section, SectionIndicators
from railtrack_ros.estimation.samples import SAMPLE_BLOCK
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.report.content import Latency, Report
from railtrack_ros.report.page import write_report
from railtrack_ros.runs import comparison
from railtrack_ros.runs.configuration import write_configuration
from railtrack_ros.runs.driven import LONGEST_STEP
from railtrack_ros.runs.remarks import Remarks, told
from railtrack_ros.runs.replay_files import ReplayFiles, complete_folder, write_errors
from railtrack_ros.runs.replay_input import Stretch, StretchCutter
from railtrack_ros.runs.replay_model import SECTION, Extent, Replayed, Samples, replay
from railtrack_ros.runs.replay_report import (
    About,
    overall,
    parameters,
    replay_report,
    unexplained,
    worst,
)
from railtrack_ros.runs.replay_spectra import WeightedSpectra, spectra
from railtrack_ros.runs.report_parts import corrugation_cards, indicators_of
from railtrack_ros.track.bay import Mesh
from railtrack_ros.track.description import Track
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import Vehicle

RESULT = '/contact_force'          # the result whose arrival tells the latency
LATENCY = ('From the arrival of a block of acceleration at the recorder to the arrival of its '
           'contact force there: transport, estimate and publication.')

Progress = Callable[[float], None]

# A stretch is replayed in windows of this duration [s], so that memory does not grow with it.
WINDOW = 8.0
# A piece at the end of a stretch that is too short to be compared and not worth a remark [s].
NOT_WORTH_TELLING = 1.0


@dataclass
class EstimatedRun:
    """A recording after the estimator, summed up."""

    settings: EstimatorSettings
    analysis: TrackAnalysis
    sections: list[Section] = field(default_factory=list)
    latency: Latency | None = None
    blocks: int = 0
    defects: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class ReplayResult:
    """What a replay gave: the comparison, its report, a summary, and what to say on the input."""

    replayed: Replayed
    report: Report
    summary: dict[str, Any]
    defects: list[str]
    remarks: list[str]


def replay_recording(
    path: Paths, track: Track, vehicle: Vehicle, output: str | Path,
    stretch: Stretch = Stretch(), start_position: float | None = None,    # noqa: B008 (frozen)
    settings: EstimatorSettings | None = None, model_track: Track | None = None,
    mesh: Mesh | None = None, longest_step: float = LONGEST_STEP, about: About | None = None,
    acceleration_topic: str | None = None, speed_topic: str | None = None,
    progress: Progress = lambda seconds: None, section_length: float = SECTION,
    window: float = WINDOW, sample_block: float = SAMPLE_BLOCK,
) -> ReplayResult:
    """Replay a recording through the full model and write report, CSV and MCAP files.

    Parameters
    ----------
    path, output
        The recording, or several that are one run, and the folder for ``report.html``,
        ``comparison.csv``, ``errors.csv`` and ``replay.mcap``. The files appear when all of them
        are complete.
    track, vehicle, settings
        What the estimator works with.
    stretch
        The part of the run that is replayed.
    start_position
        Track position of the reference point at the first sample [m]; None: as recorded, else 0.
    model_track, mesh
        What the full model works with, if not `track` and the estimator's mesh. The full model
        takes any track, also an uneven or a non-linear one.
    longest_step
        Upper bound of the full model's time step [s].
    about
        Title and further content of the report.
    acceleration_topic, speed_topic
        Input topics; None for the usual ones.
    progress
        Called with the seconds of the recording that are done.
    section_length
        Of the sections of track that errors are summed up over [m].
    window
        Duration of the pieces that the stretch is replayed in [s], each with a run-up: memory is
        that of two of them.
    sample_block
        Single samples are gathered to blocks of about this length [s].

    Raises
    ------
    InputError
        The recording cannot be estimated, or there is nothing to compare in the stretch.
    """
    model_track = model_track or track
    name = paths_of(path)[0].name
    settings = settings or EstimatorSettings()
    mesh = mesh or settings.mesh
    row = BayRow(model_track, mesh)
    text = write_configuration(model_track, vehicle, settings, IndicatorSettings())
    with complete_folder(Path(output)) as place, ReplayFiles(place, vehicle, text) as files:
        windows = _Windows(files)

        def take(samples: Samples, part: slice, settings: EstimatorSettings) -> None:
            windows.add(replay(samples, part, row, vehicle, settings, longest_step,
                               section_length=section_length), vehicle)

        run = estimate_run(path, track, vehicle, settings, stretch, take,
                           start_position, acceleration_topic, speed_topic, progress, window,
                           sample_block)
        found = windows.result()
        about = about or About(f'Replay of {name}', '')
        described = parameters(model_track, mesh, vehicle, run.settings, found)
        described = {'recording': {'file': name, 'blocks': str(run.blocks)}, **described}
        about = replace(
            about, parameters={**described, **(about.parameters or {})},
            subtitle=about.subtitle or f'{name}, track {track.name}, vehicle {vehicle.name}')
        judge = run.analysis.judge
        report = replay_report(
            found, vehicle, about, indicators_of(run.sections, judge), run.latency,
            windows.spectra.mean(), corrugation_cards(run.analysis.found, judge, vehicle))
        write_errors(place / 'errors.csv', found.errors)
        write_report(place / 'report.html', report)
    return ReplayResult(found, report, _summary(path, output, run, found), run.defects,
                        run.remarks)


class _Windows:
    """What the windows of a stretch have given: the errors of all, the curves of one."""

    def __init__(self, files: ReplayFiles) -> None:
        self.spectra = WeightedSpectra()
        self._files = files
        self._errors: list[list[comparison.Error]] = []
        self._extent: Extent | None = None
        self._shown: Replayed | None = None

    def add(self, found: Replayed, vehicle: Vehicle) -> None:
        """Take a window that is replayed."""
        self._files.add(found)
        self._errors.append(found.errors)
        self.spectra.add(spectra(found, vehicle), found.extent.duration)
        extent = found.extent
        self._extent = extent if self._extent is None else self._extent.joined(extent)
        if self._shown is None or _interest(found) > _interest(self._shown):
            self._shown = found

    def result(self) -> Replayed:
        """Return one result: the curves of the window with most to see, all else of all."""
        assert self._shown is not None
        if len(self._errors) == 1:
            return self._shown
        return replace(self._shown, errors=comparison.merged(self._errors), whole=self._extent)


def _interest(found: Replayed) -> float:
    """Tell how much there is to see in a window: the largest RMS of irregularity in a section."""
    return max((line.rms_difference / line.rms_reference for line in unexplained(found.errors)),
               default=0.0) * 1e3 + max(
        (comparison.rms(x[found.stretch]) for x in found.excitation.values()), default=0.0)


Take = Callable[[Samples, slice, EstimatorSettings], None]


def estimate_run(path: Paths, track: Track, vehicle: Vehicle, settings: EstimatorSettings,
                 stretch: Stretch, take: Take, start_position: float | None = None,
                 acceleration_topic: str | None = None, speed_topic: str | None = None,
                 progress: Progress = lambda seconds: None, window: float = math.inf,
                 sample_block: float = SAMPLE_BLOCK) -> EstimatedRun:
    """Run the estimator over a recording and hand over the samples of the stretch.

    Parameters
    ----------
    take
        Called with the samples of a window of the stretch and what that needs around it, which of
        them are the window, and the settings of the estimate.
    window
        Duration of a window [s].
    sample_block
        Single samples are gathered to blocks of about this length [s].

    Raises
    ------
    InputError
        The recording lacks acceleration or speed, the stretch lies outside of it, or no window of
        it can be used.
    """
    paths = paths_of(path)
    names = [box.name for box in vehicle.axle_boxes]
    with (read_run(paths, acceleration_topic, speed_topic, everything=True, names=names,
                   sample_block=sample_block) as run,
          open_bag(paths) as beside):
        if start_position is None:
            start_position = run.start_position
        if start_position is not None:
            settings = replace(settings, start_position=start_position)
        estimator = Estimator(track, vehicle, settings, test_model=False)
        indicators = SectionIndicators(vehicle, IndicatorSettings(), settings)
        analysis = TrackAnalysis(vehicle, IndicatorSettings(), settings, None,
                                 vehicle.wheel.radius)
        cutting = _Cutting(stretch, settings, vehicle, beside, window,
                           lambda samples, part: take(samples, part, settings))
        arrivals = _Arrivals()
        found = EstimatedRun(settings, analysis)
        remarks = Remarks()
        channels: set[str] = set()

        def estimate(event: AccelerationBlock) -> None:
            block = event.block
            channels.update(block.channels)
            result = estimator.process(block.stamp_ns, block.t, block.channels)
            if result is not None:
                found.blocks += 1
                cutting.add(block, result, event.message.log_time)
                irregularity = result.t, result.position, result.irregularity, result.stamp_ns
                found.sections += indicators.feed(*irregularity)
                analysis.feed(*irregularity)

        # As everywhere, a block is estimated when all messages of its log time are there.
        waiting: deque[AccelerationBlock] = deque()
        for event in run:
            while waiting and event.message.log_time > waiting[0].message.log_time:
                estimate(waiting.popleft())
            if isinstance(event, SpeedSample):
                estimator.add_speed(event.stamp_ns, event.speed)
            elif isinstance(event, PositionSample):
                estimator.set_position(event.stamp_ns, event.position)
            elif isinstance(event, AccelerationBlock):
                waiting.append(event)
                arrivals.came(event.block, event.message.log_time)
                progress((event.message.log_time - run.bag.start_time) / SECOND)
            elif isinstance(event, OtherMessage):
                arrivals.other(event.message)
            elif isinstance(event, Defect):
                remarks.defects.append(event.reason)
            for note in estimator.take_notes():
                remarks.note(note)
        for last in waiting:
            estimate(last)
        for note in estimator.take_notes():
            remarks.note(note)
        if channels and not channels.intersection(names):
            raise InputError(
                f'{paths[0]}: {run.acceleration_topic} has the channels '
                f'{", ".join(sorted(channels))}, none of the axle boxes of vehicle '
                f'{vehicle.name}: {", ".join(names)}')
        found.sections += indicators.finish()
        analysis.finish()
        left_out = cutting.finish()
        notes = run.bag.notes
    found.latency = arrivals.latency()
    found.defects = told([*notes, *remarks.defects, *left_out], paths[0])
    found.remarks = told(remarks.remarks, paths[0])
    return found


class _Cutting:
    """Cuts a stretch into windows, each with its own run-up and run-out, as the run goes by."""

    def __init__(self, stretch: Stretch, settings: EstimatorSettings, vehicle: Vehicle, bag: Bag,
                 window: float, take: Callable[[Samples, slice], None]) -> None:
        self._stretch, self._settings, self._vehicle = stretch, settings, vehicle
        self._bag, self._window, self._take = bag, window, take
        self._cutters = [StretchCutter(stretch, settings, vehicle)]
        self._failures: list[InputError] = []
        self._remarks: list[str] = []
        self._taken = 0

    def add(self, block: WaveformBlock, estimate: EstimateBlock, log_time: int) -> None:
        """Take the next block."""
        for cutter in self._cutters:
            cutter.add(block, estimate, log_time)
        last = self._cutters[-1]
        if last.begun is not None and last.end == math.inf and self._window < math.inf:
            last.end = last.begun + self._window
            following = StretchCutter(self._stretch, self._settings, self._vehicle, last.first_ns,
                                      last.end)
            following.add(block, estimate, log_time)
            self._cutters.append(following)
        while self._cutters[0].is_over and len(self._cutters) > 1:
            self._hand_over(self._cutters.pop(0))

    def finish(self) -> list[str]:
        """Hand over what is left; returns remarks on windows that could not be used.

        Raises
        ------
        InputError
            No window could be used.
        """
        for cutter in self._cutters:
            if cutter.begun is not None or not (self._taken or self._failures):
                self._hand_over(cutter)
        if not self._taken:
            raise self._failures[0]
        return self._remarks

    def _hand_over(self, cutter: StretchCutter) -> None:
        if cutter.begun is None and self._taken:
            return
        try:
            samples, part = cutter.finish(self._bag)
            self._take(samples, part)
            self._taken += 1
        except InputError as error:
            self._failures.append(error)
            if cutter.begun is None:
                return
            if cutter.ended - cutter.begun >= NOT_WORTH_TELLING:
                self._remarks.append(f'from {cutter.begun:.1f} to {cutter.ended:.1f} s: not '
                                     f'compared: {error}')


class _Arrivals:
    """When blocks of acceleration and their results came to the recorder."""

    def __init__(self) -> None:
        self._inputs: dict[int, int] = {}
        self._delays: list[tuple[int, int]] = []
        self._block = 0.0

    def came(self, block: WaveformBlock, log_time: int) -> None:
        """Take note of a block of acceleration."""
        self._inputs[block.stamp_ns] = log_time
        if block.samples > 1:
            self._block = max(self._block, block.samples * block.time_step)

    def other(self, message: RawMessage) -> None:
        """Take note of a result, which carries the stamp of its block."""
        if (message.type == WAVEFORM and message.topic.endswith(RESULT)
                and not message.topic.startswith('/truth/') and len(message.data) >= 12):
            order = '<' if message.data[1] & 1 else '>'
            seconds, nanoseconds = struct.unpack_from(f'{order}iI', message.data, 4)
            came = self._inputs.get(seconds * SECOND + nanoseconds)
            if came is not None:
                self._delays.append((came, message.log_time - came))

    def latency(self) -> Latency | None:
        """Return the delays, None for a recording that was not made live."""
        if not any(delay > 0 for _, delay in self._delays):
            return None
        came, delay = np.array(self._delays, dtype=np.int64).T
        return Latency((came - came.min()) / SECOND, delay / SECOND, LATENCY, self._block or None)


def _summary(path: Paths, output: str | Path, run: EstimatedRun, found: Replayed
             ) -> dict[str, Any]:
    """Return the figures of a replay under machine-readable names."""
    begin, end = found.compared
    errors = []
    for pair in dict.fromkeys((e.quantity, e.compared, e.reference) for e in found.errors):
        total, largest = overall(found.errors, *pair), worst(found.errors, *pair)
        errors.append({
            'quantity': pair[0], 'compared': pair[1], 'reference': pair[2],
            'rms_difference': None if total is None else total[0],
            'rms_reference': None if total is None else total[1],
            'worst_third_octave_db': None if largest is None else largest.level_difference,
            'worst_third_octave_hz': None if largest is None else largest.frequency,
            'worst_axle_box': None if largest is None else largest.axle_box,
        })
    return {
        'recording': str(paths_of(path)[0]),
        'output': str(output),
        'defects': run.defects,
        'remarks': run.remarks,
        'from_m': begin,
        'to_m': end,
        'duration_s': found.extent.duration,
        'speed_m_s': found.extent.speeds[1],
        'band_hz': [found.band.low, found.band.high],
        'errors': errors,
        'unexplained': [
            {'axle_box': line.axle_box, 'from_m': line.begin, 'to_m': line.end,
             'difference_db': line.difference_level} for line in unexplained(found.errors)],
        'sections': len(run.sections),
        'latency_99_s': None if run.latency is None else float(
            np.percentile(run.latency.delay, 99)),
        'files': ['report.html', 'comparison.csv', 'errors.csv', 'replay.mcap'],
    }
