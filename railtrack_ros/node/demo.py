"""The whole story on one machine: a live run on ROS 2, its recording, replay and report.

1. `virtual_vehicle` and `track_estimator` run as two ROS 2 processes that talk over DDS.
2. Everything that they publish is recorded.
3. The recording is estimated again offline and compared with the live results bit by bit.
4. A stretch of it drives the full model, and the report is written.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rclpy.executors import SingleThreadedExecutor

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, SPEED_TOPIC, Recording
from railtrack_ros.node import track_estimator, virtual_vehicle
from railtrack_ros.node.client import client
from railtrack_ros.node.processes import (
    Domain,
    Process,
    Processes,
    ros_parameters,
    transport,
)
from railtrack_ros.node.recorder import Recorder
from railtrack_ros.report.content import Tile
from railtrack_ros.report.overview import draw_overview
from railtrack_ros.runs.estimate import NODE, estimate
from railtrack_ros.runs.replay import ReplayResult, replay_recording
from railtrack_ros.runs.replay_input import Bound, Stretch
from railtrack_ros.runs.replay_report import About
from railtrack_ros.runs.results import WAVEFORMS
from railtrack_ros.runs.virtual_run import Corrugation, RunSettings
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

TRACK = 'mainline_soft_pads'
VEHICLE = 'measurement_coach'
SPEED = 25.0  # m/s
ACCELERATION = 0.2  # m/s2
WAVELENGTH = 0.045  # m
AMPLITUDE = 20e-6  # m
LEVEL = -6.0  # dB, of the roughness against the limit of ISO 3095
REPLAYED = 5.0  # s

LIVE_TOPIC = f'{NODE}/{WAVEFORMS[0]}'

# Longest times to wait: for the processes to get ready, and for the last results, s.
STARTING = 300.0
DRAINING = 10.0
# Between two lines of progress, s.
REPORT_PERIOD = 2.0

# The demonstration shares the machine with whatever else runs there: on a busy one results shall
# come late rather than not at all. A system on a train keeps the defaults.
PATIENT_INPUTS = {
    f'qos_overrides.{topic}.subscription.{name}': value
    for topic in (ACCELERATION_TOPIC, SPEED_TOPIC)
    for name, value in (('reliability', 'reliable'), ('depth', 3000))
} | {'shed_delay': 600.0}

Say = Callable[[str], None]


class DemoError(RuntimeError):
    """The demonstration could not be brought to its end."""


@dataclass
class LiveRun:
    """What the live part gave.

    Attributes
    ----------
    expected, recorded, estimated, lost
        Blocks sent by the vehicle's plan, recorded, and answered by the estimator; and messages
        of any topic that the recorder knows it has missed.
    processor_share
        Time on a processor core that the estimator took of each second, None where not known.
    """

    expected: int
    recorded: int = 0
    estimated: int = 0
    lost: int = 0
    processor_share: float | None = None


@dataclass
class DemoResult:
    """What the demonstration found.

    Attributes
    ----------
    compared, different
        Waveform messages that were estimated live and offline, and those of them that differ.
    """

    live: LiveRun
    replay: ReplayResult
    bag: Path
    report: Path
    compared: int
    different: int
    seconds: float
    defects: list[str] = field(default_factory=list)


def plan(duration: float, seed: int) -> RunSettings:
    """Return the run: rough rails, one of them corrugated over a part in the middle."""
    length = SPEED * duration + 0.5 * ACCELERATION * duration**2
    begin = 10.0 * round(0.4 * length / 10.0)
    end = max(begin + 20.0, 10.0 * round(0.52 * length / 10.0))
    return RunSettings(
        duration=duration, speed=SPEED, acceleration=ACCELERATION, roughness='iso3095',
        roughness_level=LEVEL,
        corrugations=(Corrugation(WAVELENGTH, AMPLITUDE, begin, end, 'right'),), seed=seed)


def run_demo(output: Path, duration: float, seed: int, say: Say) -> DemoResult:
    """Run the demonstration and leave bag, report and logs in a folder.

    Parameters
    ----------
    output
        The folder; files of an earlier demonstration in it are replaced.
    duration
        Length of the run, s.
    seed
        Of roughness and noise.
    say
        Called with lines of progress.

    Raises
    ------
    InputError
        The output cannot be written.
    DemoError
        A process ended before its time; the message holds its last words.
    """
    begun = time.monotonic()
    settings = plan(duration, seed)
    bag, logs = output / 'live.mcap', output / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    stretch = settings.corrugations[0]
    say(f'{VEHICLE} on {TRACK}: {duration:g} s at {SPEED:g} m/s and faster; the '
        f'{stretch.rail} rail is corrugated from {stretch.begin:g} to {stretch.end:g} m')
    live = _LiveDemo(settings, bag, logs, say).run()
    say(f'recorded: {bag} ({bag.stat().st_size / 1e6:.0f} MB)')

    track, vehicle = load_track(TRACK), load_vehicle(VEHICLE)
    say('offline: the estimator over the recording')
    estimated = output / 'estimated.mcap'
    found = estimate(bag, track, vehicle, estimated)
    compared, different = compare(bag, estimated)
    say(f'offline: {compared - different} of {compared} waveforms equal the live ones '
        'to the last bit')

    say(f'replay: {_replayed(settings)} through the full model')
    replay = replay_recording(
        bag, track, vehicle, output, _replayed(settings), about=_about(live, compared, different))
    draw_overview(output / 'overview.png', replay.report)
    say(f'report written, {time.monotonic() - begun:.0f} s after the start')
    return DemoResult(live, replay, bag, output / 'report.html', compared, different,
                      time.monotonic() - begun, _defects(live, compared, different, found.defects))


def _replayed(settings: RunSettings) -> Stretch:
    """Return the stretch that drives the full model: about the middle of the corrugation."""
    corrugated = settings.corrugations[0]
    length = min(REPLAYED, 0.4 * settings.duration) * SPEED
    middle = 0.5 * (corrugated.begin + corrugated.end)
    return Stretch(*(Bound(round(middle + side * length), 'm') for side in (-0.5, 0.5)))


class _LiveDemo:
    """The live part: two processes, and the recorder in this one."""

    def __init__(self, settings: RunSettings, bag: Path, logs: Path, say: Say) -> None:
        self._settings = settings
        self._bag = bag
        self._logs = logs
        self._say = say
        self._ready = False
        self._running = False

    def run(self) -> LiveRun:
        """Run until the vehicle has sent everything and the estimator has answered."""
        domain = Domain()
        try:
            environment = {**domain.environment(self._logs), **transport()}
            self._say(f'live: two ROS 2 processes on this machine only, domain {domain.number}')
            with (
                _interruptible(),
                Processes(environment, self._logs) as processes,
                _variables(environment),
                Recording(self._bag, survive=True) as recording,
                client('railtrack_demo') as (node, executor),
            ):
                estimator = processes.start(
                    'track_estimator', track_estimator.__name__, ros_parameters(
                        {'track': TRACK, 'vehicle': VEHICLE, **PATIENT_INPUTS}),
                    self._listen_estimator)
                vehicle = processes.start(
                    'virtual_vehicle', virtual_vehicle.__name__, ros_parameters(
                        self._vehicle_parameters()), self._listen_vehicle)
                recorder = Recorder(node, recording)
                return self._follow(executor, recorder, estimator, vehicle)
        finally:
            domain.close()

    def _vehicle_parameters(self) -> dict[str, object]:
        settings = self._settings
        return {
            'track': TRACK, 'vehicle': VEHICLE, 'duration': settings.duration,
            'speed': settings.speed, 'acceleration': settings.acceleration,
            'roughness': settings.roughness, 'roughness_level': settings.roughness_level,
            'seed': settings.seed,
            'corrugation': ' '.join(map(str, settings.corrugations)),
            'subscribers': 2,  # estimator and recorder
            'patience': STARTING,
        }

    def _listen_estimator(self, severity: str, text: str) -> None:
        self._ready = self._ready or text.startswith('ready')
        self._say(f'live: estimator: {text}')

    def _listen_vehicle(self, severity: str, text: str) -> None:
        self._running = self._running or text == 'running'
        self._say(f'live: vehicle: {text}')

    def _follow(self, executor: SingleThreadedExecutor, recorder: Recorder, estimator: Process,
                vehicle: Process) -> LiveRun:
        """Record until the end of the run."""
        blocks = math.ceil(self._settings.samples / self._settings.samples_per_block)
        found = LiveRun(expected=blocks)
        deadline = time.monotonic() + STARTING + self._settings.duration
        used: list[tuple[float, float | None]] = []
        said = time.monotonic()
        while vehicle.status is None:
            executor.spin_once(timeout_sec=0.05)
            _check(estimator)
            now = time.monotonic()
            if now > deadline:
                raise DemoError(f'the vehicle has not finished in time:\n{vehicle.tail()}')
            if self._running and not used:
                used.append((now, estimator.processor_time()))
            if self._running and now - said > REPORT_PERIOD:
                said = now
                self._say(f'live: {recorder.received[ACCELERATION_TOPIC]} of {blocks} blocks '
                          f'sent, {recorder.received[LIVE_TOPIC]} estimated')
        if vehicle.status != 0:
            raise DemoError(f'the vehicle has failed:\n{vehicle.tail()}')
        used.append((time.monotonic(), estimator.processor_time()))
        _drain(executor, recorder)
        status = estimator.stop()
        if status != 0:
            raise DemoError(f'the estimator has ended with status {status}:\n{estimator.tail()}')
        found.recorded = recorder.received[ACCELERATION_TOPIC]
        found.estimated = recorder.received[LIVE_TOPIC]
        found.lost = recorder.lost.total()
        found.processor_share = _share(used)
        return found


def _check(process: Process) -> None:
    if process.status is not None:
        raise DemoError(f'{process.name} has ended before its time:\n{process.tail()}')


def _drain(executor: SingleThreadedExecutor, recorder: Recorder) -> None:
    """Record until there is an answer to every block, or until it is quiet."""
    quiet_since, last = time.monotonic(), -1
    while time.monotonic() - quiet_since < DRAINING:
        executor.spin_once(timeout_sec=0.05)
        received = recorder.received
        if received[LIVE_TOPIC] != last:
            quiet_since, last = time.monotonic(), received[LIVE_TOPIC]
        elif received[LIVE_TOPIC] >= received[ACCELERATION_TOPIC] and (
                time.monotonic() - quiet_since > 1.0):
            return


def _share(used: list[tuple[float, float | None]]) -> float | None:
    if len(used) < 2 or used[0][1] is None or used[1][1] is None:
        return None
    return (used[1][1] - used[0][1]) / (used[1][0] - used[0][0])


@contextmanager
def _interruptible() -> Iterator[None]:
    """Have SIGTERM do what Ctrl-C does: leave through all that cleans up."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _variables(environment: Mapping[str, str]) -> Iterator[None]:
    """Set variables of this process for a time."""
    before = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def compare(live: Path, offline: Path) -> tuple[int, int]:
    """Compare the waveforms of a live run with those estimated from its recording.

    Returns
    -------
    tuple
        Number of waveforms that either of them has, and how many of these are not equal in every
        bit of time, position and values.
    """
    topics = {f'{NODE}/{name}' for name in WAVEFORMS}
    compared = different = 0
    with open_bag(live) as a, open_bag(offline) as b:
        for topic in topics:
            first, second = (
                {(m.header.stamp.sec, m.header.stamp.nanosec): bytes(m.data)
                 for m in map(bag.decode, bag.messages({topic}))} for bag in (a, b))
            compared += len(first.keys() | second.keys())
            different += sum(first.get(stamp) != second.get(stamp)
                             for stamp in first.keys() | second.keys())
    return compared, different


def _about(live: LiveRun, compared: int, different: int) -> About:
    """Return what the report says of the live run."""
    lost = max(live.expected - live.estimated, 0)
    tiles = [
        Tile('blocks lost live', str(lost), f'of {live.expected}'),
        Tile('live = offline', 'yes' if not different else 'no',
             f'{compared - different} of {compared} waveforms equal to the last bit'),
    ]
    findings = [
        f'{live.estimated} of {live.expected} blocks of acceleration were estimated live, and '
        f'{compared - different} of {compared} waveforms equal those estimated offline to the '
        'last bit.']
    if live.processor_share is not None:
        findings.append(f'Live, the estimator took {100 * live.processor_share:.0f} % of one '
                        'processor core.')
    return About('A virtual measurement run, live on ROS 2', '', findings, tiles)


def _defects(live: LiveRun, compared: int, different: int, others: list[str]) -> list[str]:
    defects = list(others)
    if live.recorded < live.expected or live.estimated < live.expected:
        defects.append(f'of {live.expected} blocks {live.recorded} were recorded and '
                       f'{live.estimated} estimated: logs/track_estimator.log tells more')
    if different:
        defects.append(f'{different} of {compared} waveforms differ between live and offline')
    return defects


def summary(result: DemoResult) -> dict[str, Any]:
    """Return the figures of the demonstration under machine-readable names."""
    live = result.live
    return {
        'bag': str(result.bag),
        'report': str(result.report),
        'seconds': result.seconds,
        'blocks_expected': live.expected,
        'blocks_recorded': live.recorded,
        'blocks_estimated': live.estimated,
        'messages_lost_by_recorder': live.lost,
        'estimator_processor_share': live.processor_share,
        'waveforms_compared': result.compared,
        'waveforms_different': result.different,
        'findings': list(result.replay.report.findings),
        'replay': result.replay.summary,
    }
