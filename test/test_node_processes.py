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
from sensor_msgs.msg import PointCloud2

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.codec import decode_waveform
from railtrack_ros.cli.main import main
from railtrack_ros.node.client import client
from railtrack_ros.node.processes import (
    FIRST_PARTICIPANT,
    FIRST_PORT,
    PORTS_PER_DOMAIN,
    Domain,
    Processes,
    ros_parameters,
    uninterrupted,
)
from railtrack_ros.node.qos import RESULT
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


def test_a_node_that_was_told_to_end_is_gone_for_the_others_at_once(
        processes, tmp_path, monkeypatch):
    """Not only when its lease has run out, which takes DDS 20 s."""
    for name, value in processes._environment.items():
        monkeypatch.setenv(name, value)
    with client('watcher') as (node, executor):
        def known():
            executor.spin_once(timeout_sec=0.05)
            return 'recorder' in node.get_node_names()

        process = processes.start('node', RECORDER, ros_parameters(
            {'output': str(tmp_path / 'o.mcap')}))
        wait_for(known)
        assert process.stop() == 0
        ended = time.monotonic()
        wait_for(lambda: not known())
        assert time.monotonic() - ended < 10.0


@pytest.mark.parametrize('work', [
    # As numba does where LLVM calls back.
    'try: print("at work", flush=True); time.sleep(60)\n'
    'except BaseException: pass\n'
    'time.sleep(60)',
    'try: print("at work", flush=True); time.sleep(60)\n'
    'except BaseException: raise RuntimeError("no compiled object yet")',
    # A thread that computes, and is waited for.
    'with ThreadPoolExecutor() as pool:\n'
    '    print("at work", flush=True); pool.submit(time.sleep, 60).result()',
    # A callback that takes its time.
    'node = rclpy.create_node("node")\n'
    'node.create_timer(0.01, lambda: (print("at work", flush=True), time.sleep(60)))',
], ids=['swallowed', 'turned into a fault', 'thread', 'callback'])
def test_whatever_a_node_is_at_a_signal_ends_it(tmp_path, work):
    module = tmp_path / 'railtrack_ros_test_node.py'
    body = '\n'.join(f'    {line}' for line in work.splitlines())
    module.write_text(f"""
import time
from concurrent.futures import ThreadPoolExecutor
import rclpy
from railtrack_ros.node.runner import run

def make_node():
    node = None
{body}
    return node

def main():
    return run(make_node)
""")
    program = ('import sys; import railtrack_ros.node.start as s; '
               'import railtrack_ros.node; railtrack_ros.node.__path__.append(sys.argv[1]); '
               's.start("railtrack_ros_test_node")')
    with subprocess.Popen([sys.executable, '-c', program, str(tmp_path)], text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        try:
            assert child.stdout.readline() == 'at work\n'
            child.send_signal(signal.SIGTERM)
            _, errors = child.communicate(timeout=20)
        finally:
            child.kill()
    assert child.returncode == 0
    assert 'Traceback' not in errors


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
    signals = ((signal.SIGINT, 0.0), (signal.SIGINT, 0.3), (signal.SIGTERM, 0.9))
    children, logs = [], [tmp_path / f'log{i}' for i in range(len(signals))]
    try:
        for i, log in enumerate(logs):
            output = ros_parameters({'output': str(tmp_path / f'{i}.mcap')})
            with log.open('w') as file:
                children.append(subprocess.Popen(
                    [sys.executable, *command, *(output if module == RECORDER else [])],
                    stdout=file, stderr=file, cwd=tmp_path))
        slept = 0.0
        for child, (number, wait) in zip(children, signals, strict=True):
            wait_for(lambda pid=child.pid: heeds_signals(pid))
            time.sleep(wait - slept)
            slept = wait
            child.send_signal(number)
        assert [child.wait(DEADLINE) for child in children] == [0, 0, 0]
    finally:
        for child in children:
            child.kill()
            child.wait()
    assert not any('Traceback' in log.read_text() for log in logs)


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
    (RECORDER, {'a b': 1}, 'arguments after --ros-args'),
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
    path.write_text('/**:\n  ros__parameters:\n    vehicle: blanco_table_3_1\n    trak: x\n'
                    '    autostart: false\n')
    lines = Lines()
    processes.start('node', ESTIMATOR, ['--ros-args', '--params-file', str(path)], lines)
    wait_for(lambda: lines.has("parameter trak is unknown and has no effect; did you mean 'track'"))


def test_after_kill_9_it_comes_back_from_its_caches_and_takes_up_the_stream(
        processes, monkeypatch):
    """The vehicle drives on all the time; the second life begins at the start position."""
    lines, heard = Lines(), []

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
    start('second')
    for name, value in processes._environment.items():
        monkeypatch.setenv(name, value)
    with client('listener') as (node, executor):
        node.create_subscription(
            PointCloud2, '/track_estimator/contact_force', heard.append, RESULT)
        wait_for(lambda: executor.spin_once(timeout_sec=0.05) or len(heard) > 10)
    position = decode_waveform(heard[-1]).position
    assert 100.0 < position[-1] < 1000.0


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
    assert main(['play', str(source), '--rate', '2', '--wait-for', '/recorder']) == 0
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
