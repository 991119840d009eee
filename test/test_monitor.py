"""The terminal view: what it hears, what it shows, and how it ends."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import deque

import pytest
from node_bench import BOX, Bench, context_in

from railtrack_ros.bags.codec import Status
from railtrack_ros.cli.monitor import page, sparkline
from railtrack_ros.node.monitor import BoxView, View
from railtrack_ros.node.processes import Domain


def shown(view, width=160):
    from rich.console import Console

    console = Console(width=width, record=True, file=open(os.devnull, 'w'))  # noqa: SIM115
    console.print(page(view, width))
    return console.export_text()


def test_a_sparkline_goes_from_the_lowest_to_the_highest_value():
    assert sparkline([0.0, 1.0, 7.0]) == '▁▂█'
    assert sparkline([5.0, 5.0]) == '▁▁'
    assert sparkline([float('nan'), 1.0, 2.0]) == ' ▁█'
    assert sparkline([float('nan')]) == ' '


def test_the_page_shows_forces_bands_and_what_is_wrong():
    view = View('/track_estimator', heard=time.monotonic())
    view.boxes['axle1_left'] = BoxView()
    view.boxes['axle1_left'].forces.extend([57e3, 61e3, 80e3])
    view.boxes['axle1_left'].bands['30_100'] = [1.0, 12.5]
    view.parts = {
        'speed': Status(0, '', '20 m/s', '', {'speed_m_s': '20.0', 'position_m': '1234.5'}),
        'acceleration': Status(2, '', 'nobody publishes on /axle_box_acceleration'),
        'axle box axle1_left': Status(1, '', 'saturated'),
    }
    text = shown(view)
    for words in ('ERROR', '80 ▁▂█', '12.5', '30-100 mm', '1234.5 m',
                  'WARN axle box axle1_left: saturated', 'nobody publishes'):
        assert words in text
    assert view.level == 2
    # The worst comes first, what is well last.
    assert text.index('nobody publishes') < text.index('saturated') < text.index('speed: 20 m/s')


@pytest.mark.parametrize('width', [40, 60, 80, 120, 200])
def test_a_small_terminal_cuts_no_name_number_or_state(width):
    view = View('/track_estimator', heard=time.monotonic())
    for axle in range(1, 5):
        name = f'axle{axle}_right'
        view.boxes[name] = BoxView()
        view.boxes[name].forces.extend([57e3, 160e3])
        for band in ('10_30', '30_100', '100_300', '300_1000'):
            view.boxes[name].bands[band] = deque([1.0, 1234.5])
        view.parts[f'axle box {name}'] = Status(2, '', 'stuck')
    lines = shown(view, width).splitlines()
    assert all(len(line) <= width for line in lines)
    for axle in range(1, 5):
        [row] = [line for line in lines if line.startswith(f'axle{axle}_right')]
        assert '160' in row
        assert '1234.5' in row
        assert row.rstrip().endswith('ERROR')
        assert '…' not in row
    assert '…' not in next(line for line in lines if line.startswith('axle box'))


def test_what_is_old_is_not_taken_for_healthy():
    view = View('/x', parts={'speed': Status(0, '', 'fine')}, heard=time.monotonic() - 60.0)
    assert view.level == 3
    assert 'STALE' in shown(view)
    assert View('/x').level == 3


@pytest.fixture
def domain(monkeypatch, tmp_path):
    found = Domain()
    for name, value in found.environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    yield found.number
    found.close()


def command(*arguments):
    return subprocess.Popen(
        [sys.executable, '-m', 'railtrack_ros.cli.main', 'monitor', *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_it_finds_the_estimator_and_tells_its_numbers(domain):
    with context_in(domain) as context:
        bench = Bench(context)
        try:
            bench.start()
            process = command('--json', '--seconds', '6')
            end = time.monotonic() + 60.0
            while process.poll() is None and time.monotonic() < end:
                bench.run(5)
                bench.spin(0.05)
            stdout, stderr = process.communicate(timeout=30)
        finally:
            bench.close()
    assert process.returncode == 0, stderr
    summary = json.loads(stdout)
    assert summary['node'] == '/track_estimator'
    assert summary['axle_boxes'][BOX]['contact_force_n'] > 50e3
    assert float(summary['parts']['speed']['speed_m_s']) == 30.0


def test_nobody_there_is_one_line_and_status_2(domain):
    process = command('--node', '/nowhere', '--seconds', '0.5')
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 2
    assert 'nothing was heard' in stderr
    assert len(stderr.splitlines()) == 1


def test_it_ends_on_ctrl_c(domain, tmp_path):
    process = command('--node', '/nowhere', '--seconds', '600')
    end = time.monotonic() + 60.0
    while not list(tmp_path.glob('*.log')) and time.monotonic() < end:
        time.sleep(0.1)  # ROS opens its log when it starts
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode in (2, 130)
