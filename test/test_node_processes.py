"""Nodes as processes: how they start, end, and what they leave behind."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.cli.main import main
from railtrack_ros.node.processes import (
    FIRST_PARTICIPANT,
    FIRST_PORT,
    PORTS_PER_DOMAIN,
    Domain,
    Processes,
    ros_parameters,
    uninterrupted,
)
from railtrack_ros.paths import share_directory

BAGS = share_directory() / 'bags'
DEADLINE = 60.0  # s
ESTIMATOR = 'railtrack_ros.node.track_estimator'
RECORDER = 'railtrack_ros.node.recorder'
VEHICLE = 'railtrack_ros.node.virtual_vehicle'


def wait_for(condition):
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, 'nothing came of it in time'
        time.sleep(0.05)


@pytest.fixture
def processes(tmp_path):
    domain = Domain()
    try:
        with Processes(domain.environment(tmp_path), tmp_path) as found:
            yield found
    finally:
        domain.close()


def alive(pid):
    try:
        return ' Z ' not in Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1]
    except OSError:
        return False


class Lines:
    """What a process has logged."""

    def __init__(self):
        self.texts = []

    def __call__(self, severity, text):
        self.texts.append(text)

    def has(self, words):
        return any(words in text for text in self.texts)


@pytest.mark.parametrize(('module', 'parameters', 'sign', 'number'), [
    (ESTIMATOR, {'vehicle': 'blanco_table_3_1'}, 'ready', signal.SIGINT),
    (ESTIMATOR, {'vehicle': 'blanco_table_3_1'}, 'ready', signal.SIGTERM),
    (RECORDER, {'output': 'OUT'}, 'recording to', signal.SIGINT),
    (VEHICLE, {'recording': str(BAGS / 'braking_wheelset.mcap'), 'subscribers': 0}, 'running',
     signal.SIGINT),
    (VEHICLE, {'duration': 600.0}, 'computing', signal.SIGTERM),
])
def test_a_signal_ends_a_node_with_status_0(
        processes, tmp_path, module, parameters, sign, number):
    parameters = {k: str(tmp_path / 'o.mcap') if v == 'OUT' else v for k, v in parameters.items()}
    lines = Lines()
    process = processes.start('node', module, ros_parameters(parameters), lines)
    wait_for(lambda: lines.has(sign) or process.status is not None)
    os.kill(process.pid, number)
    wait_for(lambda: process.status is not None)
    assert process.stop() == 0, process.tail()
    assert 'Traceback' not in process.log_file.read_text()


def heeds_signals(pid):
    """Return whether a process has a handler of SIGTERM; Python itself sets none."""
    caught = re.search(r'^SigCgt:\s*(\w+)$', Path(f'/proc/{pid}/status').read_text(), re.MULTILINE)
    return caught is not None and bool(int(caught[1], 16) & 1 << signal.SIGTERM - 1)


@pytest.mark.skipif(sys.platform != 'linux', reason='reads /proc')
@pytest.mark.parametrize('script', [False, True])
@pytest.mark.parametrize('module', [ESTIMATOR, RECORDER, VEHICLE])
def test_a_signal_during_the_imports_ends_a_node_with_status_0(tmp_path, module, script):
    """The handler is there first: the imports take a second or more."""
    program = f'from railtrack_ros.node import start; start.{module.rpartition(".")[2]}()'
    command = ['-c', program] if script else ['-m', module]
    if module == RECORDER:
        command += ros_parameters({'output': str(tmp_path / 'o.mcap')})
    for number, wait in ((signal.SIGINT, 0.0), (signal.SIGINT, 0.3), (signal.SIGTERM, 0.9)):
        (tmp_path / 'o.mcap').unlink(missing_ok=True)
        with (tmp_path / 'log').open('w+') as log, subprocess.Popen(
                [sys.executable, *command], stdout=log, stderr=log, cwd=tmp_path) as child:
            try:
                wait_for(lambda pid=child.pid: heeds_signals(pid))
                time.sleep(wait)
                child.send_signal(number)
                assert child.wait(DEADLINE) == 0
            finally:
                child.kill()
            log.seek(0)
            assert 'Traceback' not in log.read()


def test_the_programs_of_the_nodes_are_those_that_heed_signals_at_once():
    programs = {entry.name: entry.value for entry in entry_points(group='console_scripts')
                if entry.value.startswith('railtrack_ros.node')}
    assert programs == {name: f'railtrack_ros.node.start:{name}' for name in (
        'track_estimator', 'virtual_vehicle', 'recorder')}


@pytest.mark.parametrize(('module', 'parameters', 'words'), [
    (ESTIMATOR, {'track': 'nowhere'}, "unknown track 'nowhere'"),
    (ESTIMATOR, {'cut_on_wavelength': 3}, 'parameter cut_on_wavelength: expected a number with'),
    (ESTIMATOR, {'bays_in_ring': -4}, 'parameter bays_in_ring'),
    (VEHICLE, {'corrugation': '1:2'}, 'WAVELENGTH:AMPLITUDE:FROM:TO'),
    (VEHICLE, {'recording': '/nowhere.mcap'}, '/nowhere.mcap'),
    (RECORDER, {}, 'parameter output'),
])
def test_what_cannot_be_done_ends_a_node_with_status_2_and_a_sentence(
        processes, module, parameters, words):
    process = processes.start('node', module, ros_parameters(parameters))
    wait_for(lambda: process.status is not None)
    assert process.stop() == 2
    text = process.log_file.read_text()
    assert words in text
    assert 'Traceback' not in text


def test_an_unknown_parameter_of_a_file_is_told_by_name(processes, tmp_path):
    path = tmp_path / 'parameters.yaml'
    path.write_text('/**:\n  ros__parameters:\n    vehicle: blanco_table_3_1\n    trak: x\n')
    lines = Lines()
    processes.start('node', ESTIMATOR, ['--ros-args', '--params-file', str(path)], lines)
    wait_for(lambda: lines.has('ready'))
    assert lines.has("parameter trak is unknown and has no effect; did you mean 'track'?")


def test_after_kill_9_it_comes_back_from_its_caches_and_takes_up_the_stream(processes, tmp_path):
    """The vehicle drives on all the time; what the second life publishes continues in position."""
    lines = Lines()

    def start(name):
        return processes.start(name, ESTIMATOR, ros_parameters(
            {'vehicle': str(BAGS / 'two_wheels.yaml'), 'start_position': 100.0}), lines)

    first = start('first')
    wait_for(lambda: lines.has('ready'))
    processes.start('vehicle', VEHICLE, ros_parameters(
        {'recording': str(BAGS / 'corrugated_two_wheels.mcap'), 'loop': True, 'truth': False}),
        lines)
    wait_for(lambda: lines.has('running'))
    os.kill(first.pid, signal.SIGKILL)
    wait_for(lambda: first.status is not None)
    lines.texts.clear()
    start('second')
    wait_for(lambda: lines.has('ready'))
    copy = tmp_path / 'after.mcap'
    recorder = processes.start('recorder', RECORDER, ros_parameters(
        {'output': str(copy), 'topics': '/track_estimator/contact_force'}), lines)
    wait_for(lambda: lines.has('recording'))
    time.sleep(3.0)
    assert recorder.stop() == 0
    with open_bag(copy) as bag:
        assert bag.topics['/track_estimator/contact_force'].count > 10


def test_played_messages_are_recorded_byte_for_byte(processes, tmp_path, monkeypatch):
    """`railtrack play` in this process, the recorder in another."""
    lines = Lines()
    copy = tmp_path / 'copy.mcap'
    recorder = processes.start(
        'recorder', RECORDER, ros_parameters({'output': str(copy)}), lines)
    wait_for(lambda: lines.has('recording'))
    for name, value in processes._environment.items():
        monkeypatch.setenv(name, value)
    source = BAGS / 'braking_wheelset.mcap'
    assert main(['play', str(source), '--rate', '2']) == 0
    assert recorder.stop() == 0
    with open_bag(source) as a, open_bag(copy) as b:
        for topic in a.topics:
            sent = [m.data for m in a.messages({topic})]
            received = [m.data for m in b.messages({topic})]
            assert len(received) == len(sent)
            for first, second in zip(sent, received, strict=True):
                # DDS fills up to whole words.
                assert second == first + bytes(-len(first) % 4)
        assert b.topics['/clock'].count > 10


def test_no_process_survives_an_error_of_the_program_that_started_it(tmp_path, monkeypatch):
    monkeypatch.setattr('railtrack_ros.node.processes.PATIENCE', 0.5)
    domain = Domain()
    stubborn = 'import signal, time\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n'
    (tmp_path / 'stubborn.py').write_text(stubborn + 'print("[INFO] [x]: up", flush=True)\n'
                                          'time.sleep(600)\n')
    lines = Lines()
    environment = {**domain.environment(tmp_path), 'PYTHONPATH': str(tmp_path)}
    process = None

    def fail():
        nonlocal process
        with Processes(environment, tmp_path) as processes:
            process = processes.start('stubborn', 'stubborn', [], lines)
            wait_for(lambda: lines.has('up'))
            raise ValueError('something went wrong')

    with pytest.raises(ValueError, match='something went wrong'):
        fail()
    domain.close()
    assert process.status == -signal.SIGTERM


@pytest.mark.skipif(sys.platform != 'linux', reason='the kernel does it on Linux only')
def test_no_process_survives_the_death_of_the_program_that_started_it(tmp_path):
    parent = subprocess.Popen([sys.executable, '-c', f"""
from pathlib import Path
import time
from railtrack_ros.node.processes import Processes
processes = Processes({{}}, Path({str(tmp_path)!r}))
print(processes.start('child', 'http.server', ['0', '--bind', '127.0.0.1']).pid, flush=True)
time.sleep(600)
"""], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    parent.kill()
    parent.communicate()
    wait_for(lambda: not alive(child))


def test_a_signal_while_a_process_is_started_comes_when_it_is_known():
    order = []
    with pytest.raises(KeyboardInterrupt), uninterrupted():  # noqa: PT012
        signal.raise_signal(signal.SIGINT)
        order.append('went on')
    assert order == ['went on']
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_two_programs_never_get_the_same_domain():
    domains = [Domain() for _ in range(8)]
    assert len({domain.number for domain in domains}) == 8
    for domain in domains:
        domain.close()


def test_a_domain_that_somebody_uses_is_left_alone(monkeypatch):
    monkeypatch.setattr('railtrack_ros.node.processes.LAST_DOMAIN', 2)
    taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        taken.bind(('127.0.0.1', FIRST_PORT + PORTS_PER_DOMAIN * 1 + FIRST_PARTICIPANT))
    except OSError:
        pytest.skip('domain 1 is in use on this machine')
    with taken:
        try:
            domain = Domain()
        except RuntimeError:
            return  # domain 2 is in use as well
        assert domain.number == 2
        domain.close()
