"""Speed and memory of recordings: reading, estimating, and 10 km of a measuring train at once.

Eight axle boxes at 25.6 kHz, blocks of 10 ms. What the acceleration holds does not matter for the
speed: it is noise. The commands run as processes of their own, so that a figure holds start-up,
reading and writing too.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Figure, best_time

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.codec import SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, Recording
from railtrack_ros.vehicle.description import load_vehicle

TITLE = 'recordings'

TRACK, VEHICLE = 'mainline_soft_pads', 'measurement_coach'
RATE, SIZE = 25600.0, 256
SPEED = 30.0  # m/s
LENGTH = 10_000.0  # m
SHORT = 40.0  # s, of the run that one core is measured with
EXTRA = ('/other/one', '/other/two', '/other/three')  # what else a recorder has taken along
POOL = 2000  # blocks of noise, further apart than a compressor looks
JOBS = 2


def figures() -> Iterator[Figure]:
    """Measure; the long runs take about three minutes."""
    with tempfile.TemporaryDirectory(prefix='railtrack_benchmark_') as folder:
        short = make(Path(folder) / 'short.mcap', SHORT, ())
        size = short.stat().st_size / 1e6
        decoded = SHORT * RATE / SIZE * 40.0 * SIZE / 1e6
        yield Figure('reading and decoding, MB of samples a second',
                     decoded / best_time(lambda: read(short), 3), 'MB/s', at_least=100.0)
        yield Figure('size of a second of 8 axle boxes on disk', size / SHORT, 'MB')
        one = estimate(short, '--jobs', '1')
        yield Figure('estimate, one core, with start-up', SHORT / one['wall'], 'x real time')
        begin = start_up(Path(folder))
        yield Figure('estimate, per second of processor time, reading and writing included',
                     SHORT / (one['processor'] - begin['processor']), 'x real time', at_least=8.0)

        line = make(Path(folder) / 'line.mcap', LENGTH / SPEED, ())
        both = estimate(line, '--jobs', str(JOBS), '--report', str(Path(folder) / 'line.html'))
        yield Figure(f'10 km at 30 m/s, 8 axle boxes: estimate, indicators, report, {JOBS} jobs',
                     both['wall'], 's', at_most=60.0)
        yield Figure(f'the same, processor time by {JOBS}', both['processor'] / JOBS, 's')
        line.unlink()
        large = make(Path(folder) / 'large.mcap', LENGTH / SPEED, EXTRA)
        size = large.stat().st_size / 1e9
        all_of_it = estimate(large, '--jobs', '1')
        yield Figure(f'largest memory of the estimate of a bag of {size:.2g} GB',
                     all_of_it['largest'], 'MB', at_most=500.0)


def make(path: Path, seconds: float, extra: tuple[str, ...]) -> Path:
    """Write a run of so many seconds."""
    vehicle = load_vehicle(VEHICLE)
    rng = np.random.default_rng(0)
    names = [box.name for box in vehicle.axle_boxes]
    noise = (20.0 * rng.standard_normal((len(names), POOL * SIZE))).astype(np.float32)
    t = np.arange(SIZE) / RATE
    with Recording(path) as recording:
        for block in range(round(seconds * RATE / SIZE)):
            stamp = START_NS + block * SECOND // 100
            recording.write_speed(stamp, SPEED)
            for number, topic in enumerate((ACCELERATION_TOPIC, *extra)):
                begin = SIZE * ((block + 500 * number) % POOL)
                channels = dict(zip(names, noise[:, begin:begin + SIZE], strict=True))
                recording.write_waveform(topic, WaveformBlock(stamp, t, channels))
    return path


def read(path: Path) -> None:
    """Read and decode every waveform."""
    with open_bag(path) as bag:
        for message in bag.messages({ACCELERATION_TOPIC}):
            bag.waveform(message)


def start_up(folder: Path) -> dict[str, Any]:
    """Cost of an estimate over next to nothing: the program, the modes of the track."""
    tiny = make(folder / 'tiny.mcap', 0.5, ())
    return min((estimate(tiny) for _ in range(2)), key=lambda found: float(found['processor']))


def estimate(bag: Path, *options: str) -> dict[str, Any]:
    """Run the command; returns its summary, its time, processor time [s] and memory [MB].

    Processor time and memory are those of all its processes together; `largest` is the largest
    resident memory that one of them ever had, as the system tells.
    """
    output = bag.with_name(f'{bag.stem}_estimate.mcap')
    command = [sys.executable, '-m', 'railtrack_ros.cli.main', 'estimate', str(bag), '--track',
               TRACK, '--vehicle', VEHICLE, '--output', str(output), '--json', *options]
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                               text=True, env={**os.environ, 'NUMBA_NUM_THREADS': '1'})
    memory = Memory(process.pid)
    assert process.stdout is not None
    said = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - begun
    output.unlink(missing_ok=True)
    if process.returncode not in (0, 3):
        raise RuntimeError(f'{" ".join(command)}: exit status {process.returncode}')
    return {**json.loads(said), 'wall': wall, 'processor': usage.ru_utime + usage.ru_stime,
            'memory': memory.end(), 'largest': 1e-3 * usage.ru_maxrss}


class Memory:
    """Largest resident memory [MB] of a process and those that it has begun, looked at often."""

    def __init__(self, number: int) -> None:
        self._number, self._most, self._going = number, 0.0, True
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()

    def end(self) -> float:
        """Stop looking; returns the largest."""
        self._going = False
        self._thread.join()
        return self._most

    def _watch(self) -> None:
        while self._going:
            self._most = max(self._most, sum(map(resident, family(self._number))))
            time.sleep(0.1)


def family(number: int) -> list[int]:
    """Return a process and its descendants, where the system tells (Linux)."""
    found = [number]
    for parent in found:
        with contextlib.suppress(OSError):
            for task in Path(f'/proc/{parent}/task').iterdir():
                found += map(int, (task / 'children').read_text().split())
    return found


def resident(number: int) -> float:
    """Return the resident memory [MB] of a process, 0 where it has ended."""
    with contextlib.suppress(OSError, IndexError, ValueError):
        pages = int(Path(f'/proc/{number}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 1e6
    return 0.0
