"""The demonstration from end to end, and what is left of it when it is interrupted."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.cli.main import main
from railtrack_ros.node import demo
from railtrack_ros.node.demo import LiveRun, plan

DEADLINE = 240.0  # s


def run(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, '-m', 'railtrack_ros.cli.main', 'demo', *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def processes_of(folder):
    """Return the processes that log into a folder."""
    found = []
    for place in Path('/proc').glob('[0-9]*'):
        try:
            environment = (place / 'environ').read_bytes()
            state = (place / 'stat').read_text().rsplit(')', 1)[1].split()[0]
        except OSError:
            continue
        if str(folder).encode() in environment and state != 'Z' and int(place.name) != os.getpid():
            found.append(int(place.name))
    return found


def test_the_demonstration_from_end_to_end(tmp_path):
    output = tmp_path / 'output'
    process = run('--output', output, '--duration', '3', '--json')
    stdout, stderr = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, stderr
    assert processes_of(output) == []

    # Not one block is lost, and live is offline to the last bit.
    summary = json.loads(stdout)
    assert summary['blocks_expected'] == 300
    assert summary['blocks_recorded'] == summary['blocks_estimated'] == 300
    assert summary['messages_lost_by_recorder'] == 0
    assert summary['waveforms_compared'] == 900
    assert summary['waveforms_different'] == 0

    # The corrugated stretch is found.
    stretch = plan(3.0, 1).corrugations[0]
    said = summary['findings'][0]
    assert f'The {stretch.rail} rail is corrugated' in said
    assert f'{stretch.begin:.0f} m' in said
    assert f'{stretch.end:.0f} m' in said
    assert f'{1e3 * stretch.wavelength:.0f} mm' in said

    # Report, recording and logs are there, and the terminal told how it went.
    report = (output / 'report.html').read_text()
    assert (output / 'overview.png').read_bytes().startswith(b'\x89PNG')
    assert '<html' in report
    assert 'live on ROS 2' in report
    with open_bag(output / 'live.mcap') as bag:
        assert {'/axle_box_acceleration', '/speed', '/truth/contact_force', '/diagnostics',
                '/track_estimator/irregularity'} <= set(bag.topics)
    assert (output / 'logs' / 'track_estimator.log').stat().st_size > 0
    for words in ('estimator: ready', 'vehicle: running', 'to the last bit'):
        assert words in stderr


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demonstration_leaves_no_process(tmp_path, number):
    process = run('--output', tmp_path / 'output', '--duration', '60')
    end = time.monotonic() + DEADLINE
    while len(processes_of(tmp_path)) < 2:
        assert time.monotonic() < end
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=DEADLINE)
    while processes_of(tmp_path):
        assert time.monotonic() < end
        time.sleep(0.1)
    assert 'Traceback' not in stderr
    assert process.returncode == 130


def test_a_process_that_ends_before_its_time_is_told_with_its_last_words(
        tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, 'TRACK', 'nowhere')
    assert main(['demo', '--output', str(tmp_path / 'output'), '--duration', '3']) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "unknown track 'nowhere'" in error
    assert processes_of(tmp_path) == []


def test_a_file_in_the_place_of_the_output_is_refused(tmp_path, capsys):
    (tmp_path / 'output').write_text('mine')
    assert main(['demo', '--output', str(tmp_path / 'output')]) == 2
    assert 'is a file' in capsys.readouterr().err
    assert (tmp_path / 'output').read_text() == 'mine'


@pytest.mark.parametrize('duration', [3.0, 5.0, 20.0, 120.0])
def test_the_planned_corrugation_is_run_over_by_every_wheel(duration):
    settings = plan(duration, 1)
    stretch = settings.corrugations[0]
    end = float(settings.position_at(duration))
    assert 6.0 < stretch.begin < stretch.end < end
    assert math.fmod(stretch.begin, 10.0) == math.fmod(stretch.end, 10.0) == 0.0


@pytest.mark.parametrize(('live', 'different', 'words'), [
    (LiveRun(100, 100, 100), 0, []),
    (LiveRun(100, 99, 99), 0, ['of 100 blocks 99 were recorded']),
    (LiveRun(100, 100, 98), 0, ['98 estimated']),
    (LiveRun(100, 100, 100), 3, ['3 of 300 waveforms differ']),
])
def test_losses_and_differences_are_defects(live, different, words):
    defects = demo._defects(live, 300, different, [])
    assert len(defects) == len(words)
    for defect, word in zip(defects, words, strict=True):
        assert word in defect
