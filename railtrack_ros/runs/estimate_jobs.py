"""One run estimated by several processes, each of which takes a part of it.

The way is followed first, by the clock and the odometer of the estimator alone, so that every part
begins with exactly the time, speed and position that the whole run has there. What else the
estimator remembers (vibrations of the track, the high-pass, sections of track under way) fades
with time and distance: each process begins early enough before its part, its warm-up, for
the rest of it to be negligible. Results equal those of one process to within 1e-6 of the static
load in force, 1e-6 mm in deflection and 1e-6 mm in irregularity, positions to the last bit, and
sections within 0.2 dB (their grid of 1 mm begins where a process begins).
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import queue
import re
import signal
import tempfile
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from railtrack_ros.bags.codec import SECOND, WaveformBlock
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import (
    AccelerationBlock,
    PositionSample,
    Run,
    SpeedSample,
    read_run,
)
from railtrack_ros.bags.writer import Recording, join_recordings
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.bands import grid_step
from railtrack_ros.estimation.estimator import Array, Estimator
from railtrack_ros.estimation.indicators import Way
from railtrack_ros.runs.estimate_pipeline import (
    NODE,
    Case,
    Part,
    PartFound,
    Pipeline,
    Start,
    conclude,
)
from railtrack_ros.runs.estimated import Estimated
from railtrack_ros.runs.results import forces_are_due, section_messages

# The warm-up of a part: seconds for the track's vibrations; cut-on wavelengths for the high-pass,
# whose slowest part decays to 9 % in each; and a margin for how sections are worked off.
WARM_UP_TIME = 2.0
WARM_UP_WAVELENGTHS = 12.0
WARM_UP_MARGIN = 10.0
# Between two places at which a warm-up may begin [s].
SNAPSHOTS = 1.0
# Between two reports of progress and looks at the other process [s].
HEARTBEAT = 0.2

NOTHING_TOLD_NS = -(2**62)


def warm_up(case: Case) -> tuple[float, float]:
    """Return the warm-up of a part: seconds and metres."""
    offsets = [box.offset for box in case.vehicle.axle_boxes]
    length = max(offsets) - min(offsets)
    wavelengths = WARM_UP_WAVELENGTHS * case.settings.cut_on_wavelength
    return WARM_UP_TIME, (wavelengths + case.indicators.section_length + length + WARM_UP_MARGIN)


@dataclass
class _Snapshot:
    """A place in the run where a part may start: log time [ns], distance so far [m], `Start`."""

    time_ns: int
    distance: float
    start: bytes


class _Way(Estimator):
    """An estimator that follows the clock and the way, and estimates nothing."""

    def __init__(self, case: Case) -> None:
        super().__init__(case.track, case.vehicle, case.settings)
        self._rails = []

    def _channels(self, samples: int, channels: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Look at no sample."""
        return {}

    def start(self, sections: Way, forces_told_ns: int) -> bytes:
        """Return where the run is now."""
        return pickle.dumps(Start(self._clock, self._odometer, sections, forces_told_ns))


class Scout:
    """Follows the clock and the way through a run, for places where parts can begin."""

    def __init__(self, run: Run, case: Case) -> None:
        self._run, self._case = run, case
        self._way = _Way(case)
        self._sections = Way(
            len(case.vehicle.axle_boxes), grid_step(case.indicators.wavelengths))
        self._told_ns = NOTHING_TOLD_NS
        self._distance = 0.0

    def parts(self, jobs: int) -> Iterator[Part]:
        """Yield the parts of the run, in order and as soon as they are known."""
        start, end = self._run.bag.start_time, self._run.bag.end_time
        targets = deque(start + (end - start) * k // jobs for k in range(1, jobs))
        snapshots: deque[_Snapshot] = deque()
        first = Part()
        waiting: list[AccelerationBlock] = []
        for event in self._run:
            time_ns = event.message.log_time
            while waiting and time_ns > waiting[0].message.log_time:
                self._block(waiting.pop(0).block)
            if not waiting:
                if targets and time_ns >= targets[0]:
                    targets.popleft()
                    begun = self._begun(snapshots, time_ns)
                    if begun is not None:
                        yield replace(first, until=time_ns)
                        first = Part(begun.time_ns, time_ns, None, pickle.loads(begun.start))
                    if not targets:
                        break
                if not snapshots or time_ns - snapshots[-1].time_ns >= SNAPSHOTS * SECOND:
                    self._remember(snapshots, time_ns)
            if isinstance(event, SpeedSample):
                self._way.add_speed(event.stamp_ns, event.speed)
            elif isinstance(event, PositionSample):
                self._way.set_position(event.stamp_ns, event.position)
            elif isinstance(event, AccelerationBlock):
                waiting.append(event)
        yield first

    def _block(self, block: WaveformBlock) -> None:
        """Follow a block as the estimator does."""
        found = self._way.process(block.stamp_ns, block.t, {})
        if found is None:
            return
        self._distance += float(np.nansum(np.abs(found.speed))) * (self._way.time_step or 0.0)
        self._sections.feed(found.t, found.position, found.stamp_ns)
        if forces_are_due(self._told_ns, block.end_ns):
            self._told_ns = block.end_ns

    def _remember(self, snapshots: deque[_Snapshot], time_ns: int) -> None:
        start = self._way.start(self._sections, self._told_ns)
        snapshots.append(_Snapshot(time_ns, self._distance, start))
        while len(snapshots) > 1 and self._is_enough(snapshots[1], time_ns):
            snapshots.popleft()

    def _is_enough(self, snapshot: _Snapshot, time_ns: int) -> bool:
        seconds, metres = warm_up(self._case)
        return (time_ns - snapshot.time_ns >= seconds * SECOND
                and self._distance - snapshot.distance >= metres)

    def _begun(self, snapshots: deque[_Snapshot], time_ns: int) -> _Snapshot | None:
        """Return the last snapshot that leaves room for a warm-up, if there is one."""
        good = [s for s in snapshots if self._is_enough(s, time_ns)]
        return good[-1] if good else None


@dataclass(frozen=True)
class _Task:
    """What a process needs to know of its part."""

    number: int
    paths: list[Path]
    topics: tuple[str, str]
    case: Case
    part: Part
    output: Path


def estimate_in_parts(
    run: Run, paths: list[Path], case: Case, output: str | Path, jobs: int,
    progress: Callable[[float], None] = lambda seconds: None,
) -> Estimated:
    """Estimate a run with several processes; see :func:`railtrack_ros.runs.estimate.estimate`.

    The parts are written beside the output and joined there.
    """
    target = Path(output).expanduser().resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f'.{target.name}.', dir=target.parent) as folder:
            try:
                return _estimate(run, paths, case, output, jobs, Path(folder), progress)
            except InputError as error:  # of a part: to the user it is one output
                part = re.escape(f'{folder}{os.sep}') + r'\w+\.mcap'
                told = re.sub(part, lambda _: str(output), str(error))
                raise InputError(told) from error
    except OSError as error:
        raise InputError(f'{output}: cannot be written ({error.strerror or error})') from error


def _estimate(
    run: Run, paths: list[Path], case: Case, output: str | Path, jobs: int, folder: Path,
    progress: Callable[[float], None],
) -> Estimated:
    topics = case.topics(run)
    head, tail = folder / 'head.mcap', folder / 'tail.mcap'
    with Recording(head) as recording:
        recording.declare(topics)
        case.begin(recording, run)
    inputs = (run.acceleration_topic, run.speed_topic)
    pool = _Pool(progress)
    try:
        with read_run(paths, *inputs) as scouted:
            for number, part in enumerate(Scout(scouted, case).parts(jobs)):
                pool.start(_Task(number, paths, inputs, case, part, folder / f'{number}.mcap'))
                pool.listen()
        results = pool.wait()
    finally:
        pool.end()
    whole = results[0]
    sections = [finished for result in results for finished in result.sections]
    for later in results[1:]:
        whole.join(later)
    whole.found.sections = [s for _, finished in sections for s in finished.sections]
    with Recording(tail) as recording:
        recording.declare(topics)
        for log_time, finished in sections:
            for topic, message in section_messages(finished, OFFLINE):
                recording.write(f'{NODE}/{topic}', message, log_time)
        found = conclude(whole, run, recording, case.vehicle)
    parts = [head, *(task.output for task in pool.tasks), tail]
    join_recordings(parts, topics, output, case.facts(run), paths)
    return found


@dataclass
class _Pool:
    """The processes at work."""

    progress: Callable[[float], None]
    tasks: list[_Task] = field(default_factory=list)
    _processes: list[BaseProcess] = field(default_factory=list)
    _results: dict[int, PartFound] = field(default_factory=dict)
    _done: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._context = multiprocessing.get_context('spawn')
        self._reports: multiprocessing.Queue[tuple[int, str, Any]] = self._context.Queue()

    def start(self, task: _Task) -> None:
        """Begin with a part."""
        self.tasks.append(task)
        process = self._context.Process(target=_work, args=(task, self._reports), daemon=True)
        process.start()
        self._processes.append(process)

    def listen(self, timeout: float = 0.0) -> None:
        """Take the reports that have come.

        Raises
        ------
        InputError
            A part cannot be estimated.
        """
        try:
            while True:
                number, kind, content = self._reports.get(timeout > 0.0, timeout or None)
                if kind == 'refused':
                    raise InputError(content)
                if kind == 'failed':
                    raise RuntimeError(f'part {number} of the run: {content}')
                if kind == 'done':
                    self._results[number] = content
                else:
                    self._done[number] = content
                    self.progress(sum(self._done.values()))
        except queue.Empty:
            return

    def wait(self) -> list[PartFound]:
        """Return what the parts have found when all of them are done."""
        while len(self._results) < len(self.tasks):
            self.listen(HEARTBEAT)
            for number, process in enumerate(self._processes):
                if number not in self._results and not process.is_alive():
                    self.listen(HEARTBEAT)
                    if number not in self._results:
                        raise RuntimeError(
                            f'part {number} of the run: its process was ended from outside '
                            f'(exit status {process.exitcode})')
        return [self._results[number] for number in range(len(self.tasks))]

    def end(self) -> None:
        """Stop whatever is still at work."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()


def _work(task: _Task, reports: multiprocessing.Queue[tuple[int, str, Any]]) -> None:
    """Estimate a part in a process of its own and report to the one that has begun it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # which the parent gets too, and ends this one
    parent = multiprocessing.parent_process()
    try:
        with (read_run(task.paths, *task.topics, everything=True) as run,
              Recording(task.output) as recording):
            recording.declare(task.case.topics(run))
            pipeline = Pipeline(run, recording, task.case, task.part, separate=True)
            begin = task.part.begin or run.bag.start_time
            told = begin
            for time_ns in pipeline.steps():
                if time_ns - told > SECOND:
                    told = time_ns
                    reports.put((task.number, 'progress', (time_ns - begin) / SECOND))
                    if parent is not None and not parent.is_alive():
                        return
        reports.put((task.number, 'done', pipeline.result))
    except InputError as error:
        reports.put((task.number, 'refused', str(error)))
    except Exception:
        reports.put((task.number, 'failed', traceback.format_exc()))
