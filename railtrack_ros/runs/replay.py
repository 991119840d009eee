"""`replay` from a recording to its results: estimate, drive the full model, compare, write."""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

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
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.estimation.indicators import Section, SectionIndicators
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.report.content import Indicators, Latency, Report
from railtrack_ros.report.page import write_report
from railtrack_ros.runs import replay_files
from railtrack_ros.runs.driven import LONGEST_STEP
from railtrack_ros.runs.estimate import MOST_DEFECTS
from railtrack_ros.runs.replay_input import Stretch, StretchCutter
from railtrack_ros.runs.replay_model import Replayed, Samples, replay
from railtrack_ros.runs.replay_report import About, overall, parameters, replay_report, worst
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

RESULT = '/contact_force'          # the result whose arrival tells the latency
LATENCY = ('From the arrival of a block of acceleration at the recorder to the arrival of its '
           'contact force there: transport, estimate and publication.')

# RMS limits of E. J. Grassie, M. J. Saxon and J. D. Smith, Journal of Sound and Vibration 227
# (1999) 949: to be exceeded over less than 5 % of the length after reprofiling.
LIMITS = {'rms_10_30_um': 3.0, 'rms_30_100_um': 7.0, 'rms_100_300_um': 7.0,
          'rms_300_1000_um': 45.0}
LIMIT_SOURCE = ('RMS limits for reprofiled rails after Grassie, Saxon and Smith, Journal of Sound '
                'and Vibration 227 (1999) 949, there to be exceeded over less than 5 % of the '
                'length.')

Progress = Callable[[float], None]


@dataclass
class EstimatedRun:
    """A recording after the estimator: the stretch in full, the rest summed up."""

    settings: EstimatorSettings
    samples: Samples = field(init=False)
    stretch: slice = field(init=False)
    sections: list[Section] = field(default_factory=list)
    latency: Latency | None = None
    blocks: int = 0
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class ReplayResult:
    """What a replay gave: the comparison, its report, a summary and remarks on the input."""

    replayed: Replayed
    report: Report
    summary: dict[str, Any]
    notes: list[str]


def replay_recording(
    path: str | Path, track: Track, vehicle: Vehicle, output: str | Path,
    stretch: Stretch = Stretch(), start_position: float | None = None,    # noqa: B008 (frozen)
    settings: EstimatorSettings | None = None, model_track: Track | None = None,
    mesh: Mesh | None = None, longest_step: float = LONGEST_STEP, about: About | None = None,
    acceleration_topic: str | None = None, speed_topic: str | None = None,
    estimating: Progress = lambda seconds: None, driving: Progress = lambda share: None,
) -> ReplayResult:
    """Replay a recording through the full model and write report, CSV and MCAP files.

    Parameters
    ----------
    path, output
        The recording, and the folder for ``report.html``, ``comparison.csv``, ``errors.csv`` and
        ``replay.mcap``. The files appear when all of them are complete.
    track, vehicle, settings
        What the estimator works with.
    stretch
        The part of the run that is replayed.
    start_position
        Track position of the reference point at the first sample [m]; None: as recorded, else 0.
    model_track, mesh
        What the full model works with, if not `track` and the default mesh.
    longest_step
        Upper bound of the full model's time step [s].
    about
        Title and further content of the report.
    acceleration_topic, speed_topic
        Input topics; None for the usual ones.
    estimating, driving
        Called with the seconds of the recording that are estimated, and with the share of the
        stretch that is driven.

    Raises
    ------
    InputError
        The recording cannot be estimated, or there is nothing to compare in the stretch.
    """
    mesh = mesh or Mesh()
    model_track = model_track or track
    run = estimate_run(path, track, vehicle, settings or EstimatorSettings(), stretch,
                       start_position, acceleration_topic, speed_topic, estimating)
    found = replay(run.samples, run.stretch, make_bay(model_track, mesh), vehicle, run.settings,
                   longest_step, driving)
    about = about or About(f'Replay of {Path(path).name}', '')
    described = parameters(model_track, mesh, vehicle, run.settings, found)
    described = {'recording': {'file': Path(path).name, 'blocks': str(run.blocks)}, **described}
    about = replace(
        about, parameters={**described, **(about.parameters or {})},
        subtitle=about.subtitle or f'{Path(path).name}, track {track.name}, vehicle {vehicle.name}')
    indicators = Indicators([s.row() for s in run.sections], LIMITS, LIMIT_SOURCE)
    report = replay_report(found, vehicle, about, indicators, run.latency)
    with _folder(Path(output)) as place:
        replay_files.write_comparison(place / 'comparison.csv', found, vehicle)
        replay_files.write_errors(place / 'errors.csv', found)
        replay_files.write_waveforms(place / 'replay.mcap', found)
        write_report(place / 'report.html', report)
    return ReplayResult(found, report, _summary(path, output, run, found), run.notes)


def estimate_run(path: str | Path, track: Track, vehicle: Vehicle, settings: EstimatorSettings,
                 stretch: Stretch, start_position: float | None = None,
                 acceleration_topic: str | None = None, speed_topic: str | None = None,
                 progress: Progress = lambda seconds: None) -> EstimatedRun:
    """Run the estimator over a recording; keep the samples of the stretch and what it needs.

    Raises
    ------
    InputError
        The recording lacks acceleration or speed, or the stretch lies outside of it.
    """
    with read_run(path, acceleration_topic, speed_topic, everything=True) as run:
        if start_position is None:
            start_position = run.start_position
        if start_position is not None:
            settings = replace(settings, start_position=start_position)
        estimator = Estimator(track, vehicle, settings)
        indicators = SectionIndicators(vehicle, IndicatorSettings(), settings)
        cutter = StretchCutter(stretch, settings, vehicle)
        arrivals = _Arrivals()
        found = EstimatedRun(settings)
        remarks = [*run.bag.notes]
        channels: set[str] = set()

        def estimate(event: AccelerationBlock) -> None:
            block = event.block
            channels.update(block.channels)
            result = estimator.process(block.stamp_ns, block.t, block.channels)
            if result is not None:
                found.blocks += 1
                cutter.add(block, result)
                found.sections += indicators.feed(result.t, result.position, result.irregularity)

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
                remarks.append(event.reason)
            remarks += estimator.take_notes()
        for last in waiting:
            estimate(last)
        remarks += estimator.take_notes()
        names = [box.name for box in vehicle.axle_boxes]
        if channels and not channels.intersection(names):
            raise InputError(
                f'{path}: {run.acceleration_topic} has the channels {", ".join(sorted(channels))}, '
                f'none of the axle boxes of vehicle {vehicle.name}: {", ".join(names)}')
        found.sections += indicators.finish()
        found.samples, found.stretch = cutter.finish(run.bag)
    found.latency = arrivals.latency()
    if len(remarks) > MOST_DEFECTS:
        more = len(remarks) - MOST_DEFECTS
        remarks = [*remarks[:MOST_DEFECTS], f'and {more} more remarks on the input']
    found.notes = [f'{path}: {remark}' for remark in remarks]
    return found


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


@contextmanager
def _folder(output: Path) -> Iterator[Path]:
    """Give a place to write to; its files move into the folder when all of them are there."""
    try:
        output.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix='.part.', dir=output))
    except OSError as error:
        raise InputError(f'{output}: cannot be written ({error.strerror or error})') from error
    try:
        yield place
        for file in sorted(place.iterdir()):
            os.replace(file, output / file.name)
    except OSError as error:
        raise InputError(f'{output}: cannot be written ({error.strerror or error})') from error
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _summary(path: str | Path, output: str | Path, run: EstimatedRun, found: Replayed
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
        'recording': str(path),
        'output': str(output),
        'from_m': begin,
        'to_m': end,
        'duration_s': (run.stretch.stop - run.stretch.start) * run.samples.time_step,
        'speed_m_s': float(np.abs(run.samples.speed[run.stretch]).mean()),
        'band_hz': [found.band.low, found.band.high],
        'errors': errors,
        'sections': len(run.sections),
        'latency_99_s': None if run.latency is None else float(
            np.percentile(run.latency.delay, 99)),
        'files': ['report.html', 'comparison.csv', 'errors.csv', 'replay.mcap'],
    }
