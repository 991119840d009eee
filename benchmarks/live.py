"""The live node on this machine: latency beside a bare echo, load, memory, limits, restart, soak.

    python benchmarks/live.py                              # all of it: about 25 minutes
    python benchmarks/live.py --duration 60 --parts run    # a minute of the main figure alone

The virtual vehicle, the node and the echo run as processes of their own over DDS. The figures
replace those in docs/live_node.md, the plots go to docs/images.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import live_soak
import numpy as np
import yaml
from live_plots import plot_latency, plot_memory
from sensor_msgs.msg import PointCloud2

from railtrack_ros.bags.codec import decode_diagnostics, decode_stamp
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.cli.benchmark import processor
from railtrack_ros.node.client import client
from railtrack_ros.node.processes import (
    Domain,
    Process,
    Processes,
    resident_memory,
    ros_parameters,
    transport,
)
from railtrack_ros.node.qos import STREAM
from railtrack_ros.paths import share_directory

HERE = Path(__file__).resolve().parent
DOCUMENT = HERE.parent / 'docs' / 'live_node.md'
IMAGES = HERE.parent / 'docs' / 'images'
PARTS = ('run', 'limits', 'restart', 'soak')

BLOCK = 0.01  # s
# Length of the computed run that the vehicle sends again and again, s.
ROUND = 4.0
# The node has its first blocks behind it after so long, s: compiled code, caches of the processor.
WARM_UP = 5.0
PATIENCE = 300.0  # s, until all processes are ready
LIMITS = ((8, 25600.0), (8, 51200.0), (16, 25600.0), (16, 51200.0), (32, 25600.0), (32, 51200.0))


@dataclass
class Watched:
    """What was seen of a run from outside: processor seconds and memory over time."""

    node_delays: np.ndarray = field(default_factory=lambda: np.zeros(0))
    echo_delays: np.ndarray = field(default_factory=lambda: np.zeros(0))
    seconds: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    statuses: dict[str, Any] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    before: dict[str, int] = field(default_factory=dict)

    def counts(self) -> dict[str, int]:
        """Blocks that the node says were lost, shed or after a gap, since its start."""
        values = self.statuses['acceleration'].values if self.statuses else {}
        return {name: int(values.get(name, 0)) for name in ('lost_blocks', 'shed_blocks', 'gaps')}

    def faults(self) -> dict[str, int]:
        """The same since the end of the warm-up."""
        return {name: count - self.before.get(name, 0) for name, count in self.counts().items()}

    @property
    def missing(self) -> int:
        """Blocks without an answer between the first and the last one answered."""
        if not self.stamps:
            return -1
        span = (max(self.stamps) - min(self.stamps)) / 1e9
        return round(span / BLOCK) + 1 - len(set(self.stamps))

    @property
    def load(self) -> float:
        """Share of a core that the node used."""
        return (self.processor[-1] - self.processor[0]) / (self.seconds[-1] - self.seconds[0])

    @property
    def growth(self) -> float:
        """Growth of the memory [bytes] after the first minute (or half of a shorter run).

        Of straight lines through it, so that a single page more or less does not count.
        """
        begin = min(60.0, 0.5 * self.seconds[-1])
        chosen = [i for i, second in enumerate(self.seconds) if second >= begin]
        first = np.mean([self.memory[i] for i in chosen[:10]])
        last = np.mean([self.memory[i] for i in chosen[-10:]])
        return float(last - first)


@contextmanager
def live_system(folder: Path, vehicle: str, rate: float, echo: bool) -> Iterator[dict[str, Any]]:
    """Vehicle, node and echo as processes, and a listener, until the vehicle is running."""
    domain = Domain()
    environment = {**domain.environment(folder), **transport(), 'PYTHONPATH': os.pathsep.join(
        [str(HERE), *filter(None, [os.environ.get('PYTHONPATH')])])}
    watched = Watched()
    try:
        os.environ.update(environment)
        with Processes({}, folder) as processes, client('benchmark') as (node, executor):
            ready = []

            def listen(severity: str, text: str) -> None:
                ready.append(text)
                if severity in ('WARN', 'ERROR'):
                    watched.said.append(text)

            def start_node(name: str) -> Process:
                return processes.start(name, 'live_roles', [
                    'node', str(folder / 'node.npy'), *ros_parameters({'vehicle': vehicle})],
                    listen)

            estimator = start_node('node')
            if echo:
                processes.start('echo', 'live_roles', ['echo', str(folder / 'echo.npy')])
            source = processes.start('vehicle', 'railtrack_ros.node.virtual_vehicle',
                                     ros_parameters({
                'vehicle': vehicle, 'duration': ROUND, 'loop': True, 'truth': False,
                'sample_rate': rate, 'block': BLOCK, 'subscribers': 1,
                'patience': PATIENCE}), lambda severity, text: ready.append(text))
            node.create_subscription(
                PointCloud2, '/track_estimator/irregularity',
                lambda message: watched.stamps.append(decode_stamp(message)), STREAM)
            for name in ('contact_force', 'rail_deflection'):
                node.create_subscription(
                    PointCloud2, f'/track_estimator/{name}', lambda data: None, STREAM, raw=True)

            def diagnosed(message: Any) -> None:
                for status in decode_diagnostics(message)[1]:
                    watched.statuses[status.name.split(': ')[1]] = status

            node.create_subscription(
                LIVE.get('diagnostic_msgs/msg/DiagnosticArray'), '/diagnostics', diagnosed, STREAM)
            deadline = time.monotonic() + PATIENCE
            while 'running' not in ready or not watched.stamps:
                executor.spin_once(timeout_sec=0.1)
                for process in (estimator, source):
                    if process.status is not None or time.monotonic() > deadline:
                        raise SystemExit(f'{process.name} has failed:\n{process.tail(20)}')
            yield {'node': estimator, 'executor': executor, 'watched': watched,
                   'start_node': start_node, 'processes': processes}
    finally:
        domain.close()


def watch(vehicle: str, rate: float, duration: float, echo: bool = True) -> Watched:
    """Watch a run of so many seconds after the warm-up."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with live_system(folder, vehicle, rate, echo) as system:
            watched, executor, process = (
                system['watched'], system['executor'], system['node'])
            end = time.monotonic() + WARM_UP
            while time.monotonic() < end:
                executor.spin_once(timeout_sec=0.1)
            begun, next_look = time.monotonic(), 0.0
            warm = len(watched.stamps)
            del watched.stamps[:], watched.said[:]
            watched.before = watched.counts()
            while (passed := time.monotonic() - begun) < duration:
                executor.spin_once(timeout_sec=0.1)
                if passed >= next_look:
                    next_look += 1.0
                    watched.seconds.append(passed)
                    watched.processor.append(process.processor_time() or 0.0)
                    watched.memory.append(float(resident_memory(process.pid)))
            for child in list(system['processes']._running):
                if child.name != 'vehicle':
                    child.stop()
        watched.node_delays = np.load(folder / 'node.npy')[warm:]
        if echo:
            watched.echo_delays = np.load(folder / 'echo.npy')[warm:]
    return watched


def coach(boxes: int, folder: Path) -> str:
    """A vehicle file with so many axle boxes, on bogies 2.5 m long, half of them on each rail."""
    shipped = yaml.safe_load(
        (share_directory() / 'config/vehicles/measurement_coach.yaml').read_text())
    axles = boxes // 2
    offsets = [-19.0 * (i // 2) - 2.5 * (i % 2) for i in range(axles)]
    shipped['axle_boxes'] = [
        {'name': f'axle{i + 1}_{rail}', 'rail': rail, 'offset': offset}
        for rail in ('left', 'right') for i, offset in enumerate(offsets)]
    path = folder / f'coach_{boxes}.yaml'
    path.write_text(yaml.safe_dump(shipped))
    return str(path)


def percentiles(delays: np.ndarray) -> list[float]:
    """p50, p99 and worst [ms]."""
    return [1e3 * float(x) for x in (*np.percentile(delays, (50, 99)), delays.max())]


def measure_run(duration: float) -> dict[str, Any]:
    """The main figure: 8 axle boxes at 25.6 kHz in 10 ms blocks."""
    watched = watch('measurement_coach', 25600.0, duration)
    IMAGES.mkdir(exist_ok=True)
    plot_latency(watched.node_delays, watched.echo_delays, IMAGES / 'live_latency.png')
    plot_memory(np.array(watched.seconds), np.array(watched.memory), IMAGES / 'live_memory.png')
    faults = watched.faults()
    return {
        'duration_s': watched.seconds[-1], 'blocks': len(watched.node_delays),
        'missing': watched.missing, 'lost': faults['lost_blocks'],
        'shed': faults['shed_blocks'], 'gaps': faults['gaps'], 'load': watched.load,
        'node_ms': percentiles(watched.node_delays), 'echo_ms': percentiles(watched.echo_delays),
        'growth_mb': watched.growth / 1e6, 'memory_mb': watched.memory[-1] / 1e6,
        'load_average': os.getloadavg()[0], 'said': sorted(set(watched.said)),
    }


def measure_limits(duration: float) -> list[dict[str, Any]]:
    """How many axle boxes at which rate are sustained, and what the node says beyond."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        for boxes, rate in LIMITS:
            watched = watch(coach(boxes, Path(name)), rate, duration, echo=False)
            faults = watched.faults()
            p50, p99, worst = percentiles(watched.node_delays)
            dropped = faults['shed_blocks'] + faults['lost_blocks']
            found.append({
                'boxes': boxes, 'rate': rate, 'load': watched.load, 'p50': p50, 'p99': p99,
                'worst': worst, 'answered': len(set(watched.stamps)) * BLOCK / duration,
                'dropped': dropped,
                'says': next((text for text in watched.said if 'overload' in text), ''),
            })
            print(f'  {found[-1]}', flush=True)
            if dropped and found[-1]['answered'] < 0.5:
                break
    return found


def measure_restart() -> dict[str, float]:
    """Seconds from kill -9 and a new start to the first result, and from a signal to the end."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with live_system(folder, 'measurement_coach', 25600.0, echo=False) as system:
            watched, executor = system['watched'], system['executor']

            def spin(seconds: float) -> None:
                end = time.monotonic() + seconds
                while time.monotonic() < end:
                    executor.spin_once(timeout_sec=0.01)

            found = {}
            spin(3.0)
            process = system['node']
            os.kill(process.pid, signal.SIGKILL)
            while process.status is None:
                spin(0.05)
            spin(0.5)
            count, begun = len(watched.stamps), time.monotonic()
            process = system['start_node']('again')
            while len(watched.stamps) == count:
                spin(0.01)
            found['restart_s'] = time.monotonic() - begun
            for sign in (signal.SIGINT, signal.SIGTERM):
                spin(2.0)
                begun = time.monotonic()
                os.kill(process.pid, sign)
                while process.status is None:
                    spin(0.01)
                found[f'{sign.name}_s'] = time.monotonic() - begun
                found[f'{sign.name}_status'] = process.status
                process = system['start_node'](sign.name)
                count = len(watched.stamps)
                while len(watched.stamps) == count:
                    spin(0.05)
    return found


def table(results: dict[str, Any]) -> str:
    """The figures as they stand in the document."""
    lines = [f'{results["processor"]}, {results["cores"]} cores, Python '
             f'{".".join(map(str, sys.version_info[:3]))}; written by `make bench-live`.', '']
    if 'run' in results:
        run = results['run']
        node, echo = run['node_ms'], run['echo_ms']
        lines += [
            f'8 axle boxes at 25.6 kHz in 10 ms blocks for {run["duration_s"]:.0f} s, beside a '
            f'bare echo node, the virtual vehicle and a listener (load average '
            f'{run["load_average"]:.1f}):', '',
            '| figure | node | bare echo | meant |', '| --- | --- | --- | --- |',
            *(f'| latency {name} | {a:.2f} ms | {b:.2f} ms | {meant} ms |'
              for name, a, b, meant in zip(('p50', 'p99', 'worst'), node, echo,
                                           ('≤ 3', '≤ 10', '≤ 50'), strict=True)),
            f'| blocks answered | {run["blocks"]} | | |',
            f'| blocks lost, shed, not answered | {run["lost"]}, {run["shed"]}, {run["missing"]} '
            '| | 0 |',
            f'| share of one core | {100 * run["load"]:.0f} % | | ≤ 60 % |',
            f'| growth of memory | {run["growth_mb"]:.1f} MB of {run["memory_mb"]:.0f} MB | '
            '| ≤ 5 MB |', '']
    if 'limits' in results:
        lines += ['How far it goes (10 ms blocks):', '',
                  '| axle boxes | rate | share of one core | p50 | p99 | blocks answered | '
                  'dropped | what it says |', '|' + ' --- |' * 8]
        lines += [
            f'| {x["boxes"]} | {x["rate"] / 1e3:g} kHz | {100 * x["load"]:.0f} % | '
            f'{x["p50"]:.1f} ms | {x["p99"]:.1f} ms | {100 * min(x["answered"], 1):.0f} % | '
            f'{x["dropped"]} | {x["says"] or "-"} |' for x in results['limits']]
        lines.append('')
    if 'restart' in results:
        found = results['restart']
        lines += ['| event | time | exit status | meant |', '| --- | --- | --- | --- |',
                  f'| kill -9, new start, first result | {found["restart_s"]:.1f} s | | < 5 s |',
                  *(f'| {name} to the end of the process | {found[name + "_s"]:.2f} s | '
                    f'{found[name + "_status"]} | < 2 s |' for name in ('SIGINT', 'SIGTERM')), '']
    if 'soak' in results:
        lines += [live_soak.describe(results['soak']), '']
    return '\n'.join(lines)


def write_document(text: str) -> None:
    """Replace the figures in the document."""
    begin, end = '<!-- figures -->\n', '<!-- end of figures -->'
    document = DOCUMENT.read_text(encoding='utf-8')
    head, rest = document.split(begin, 1)
    tail = rest.split(end, 1)[1]
    DOCUMENT.write_text(f'{head}{begin}\n{text}\n{end}{tail}', encoding='utf-8')


def main() -> int:
    """Measure the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--duration', type=float, default=600.0, help='of the run, s (default 600)')
    parser.add_argument('--limit-duration', type=float, default=15.0,
                        help='of each try of "limits", s (default 15)')
    parser.add_argument('--soak-hours', type=float, default=8.0,
                        help='running time that "soak" stands for, h (default 8)')
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=PARTS)
    parser.add_argument('--results', type=Path, default=Path('build/live_results.json'),
                        help='file that keeps the figures of parts not measured this time')
    args = parser.parse_args()
    args.results.parent.mkdir(parents=True, exist_ok=True)
    results = json.loads(args.results.read_text()) if args.results.exists() else {}
    results.update(processor=processor(), cores=os.cpu_count())
    work = {
        'run': lambda: measure_run(args.duration),
        'limits': lambda: measure_limits(args.limit_duration),
        'restart': measure_restart,
        'soak': lambda: live_soak.soak(args.soak_hours),
    }
    for part in args.parts:
        print(f'{part} ...', flush=True)
        results[part] = work[part]()
        print(json.dumps(results[part], indent=1), flush=True)
        args.results.write_text(json.dumps(results, indent=1))
    text = table(results)
    print(text)
    write_document(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
