"""The launch files: what they start, with a stand-in where launch is not installed."""

import importlib
import importlib.util
import sys
import types
from pathlib import Path

import pytest
import yaml

import railtrack_ros.node
from railtrack_ros.errors import InputError
from railtrack_ros.paths import share_directory

LAUNCH = share_directory() / 'launch'
FILES = sorted(path.name for path in LAUNCH.glob('*.launch.py'))


class Recorded:
    """An action that keeps what it was made with."""

    def __init__(self, *arguments, **options):
        self.arguments = arguments
        self.options = options


class LaunchConfiguration(Recorded):
    def perform(self, context):
        return context[self.arguments[0]]


NAMES = {
    'launch': ['LaunchDescription', 'LaunchContext'],
    'launch.actions': ['DeclareLaunchArgument', 'ExecuteProcess', 'OpaqueFunction', 'Shutdown'],
    'launch.substitutions': [],
    'launch_ros': [],
    'launch_ros.actions': ['Node'],
}


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    """Modules of the names of launch and launch_ros with classes that only record."""
    for module, names in NAMES.items():
        made = types.ModuleType(module)
        for name in names:
            setattr(made, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    sys.modules['launch.substitutions'].LaunchConfiguration = LaunchConfiguration
    forget()
    yield
    forget()


def forget():
    """Have the module that imports launch imported anew."""
    sys.modules.pop('railtrack_ros.node.launching', None)
    vars(railtrack_ros.node).pop('launching', None)


def load(name):
    spec = importlib.util.spec_from_file_location('launch_file', LAUNCH / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def start(name, **given):
    """Return arguments and started actions of a launch file."""
    actions = load(name).generate_launch_description().arguments[0]
    kind = sys.modules['launch.actions'].DeclareLaunchArgument
    declared = {a.arguments[0]: a.options for a in actions if isinstance(a, kind)}
    context = {name: options['default_value'] for name, options in declared.items()}
    assert set(given) <= set(context)
    started = []
    for action in actions:
        if not isinstance(action, kind):
            started += action.options['function']({**context, **given})
    return declared, started


def parameters(node):
    """Return the parameters of a node: the file's, then those on top of it."""
    read = {}
    for part in node.options['parameters']:
        if isinstance(part, str):
            part = yaml.safe_load(Path(part).read_text())['/**']['ros__parameters']
        read.update(part)
    return read


def test_there_are_launch_files_for_live_virtual_and_recorded_runs():
    assert FILES == ['live.launch.py', 'replay.launch.py', 'virtual.launch.py']


@pytest.mark.parametrize('name', FILES)
def test_every_argument_is_described_and_every_file_starts_the_estimator(name):
    declared, started = start(name, **({'bag': 'run.mcap'} if 'replay' in name else {}))
    assert all(len(options['description']) > 10 for options in declared.values())
    assert started[0].options['executable'] == 'track_estimator'
    assert parameters(started[0])['cut_on_wavelength'] == 3.0


def test_an_argument_that_was_given_beats_the_parameter_file():
    _, [node] = start('live.launch.py', track='blanco_table_3_1', start_position='120',
                      namespace='coach7', use_sim_time='true', speed_topic='/gnss/speed',
                      autostart='false', respawn='true', log_level='warn')
    found = parameters(node)
    assert found['track'] == 'blanco_table_3_1'
    assert found['start_position'] == 120.0
    assert isinstance(found['start_position'], float)
    assert found['use_sim_time'] is True
    assert found['autostart'] is False
    # As a parameter: a remapping would miss the topics of single samples, and those of the file.
    assert found['speed_topic'] == '/gnss/speed'
    assert node.options['namespace'] == 'coach7'
    assert node.options['respawn'] is True
    assert node.options['ros_arguments'] == ['--log-level', 'warn']


def test_a_replay_needs_a_recording():
    declared, _ = start('replay.launch.py', bag='run.mcap')
    assert declared['bag']['default_value'] is None
    assert all(options['default_value'] is not None for name, options in declared.items()
               if name != 'bag')


def test_an_argument_left_empty_leaves_the_parameter_file_alone():
    _, [node] = start('live.launch.py')
    assert list(node.options['parameters'][1]) == ['use_sim_time']


def test_vehicle_and_estimator_agree_on_the_virtual_run():
    _, [estimator, vehicle] = start('virtual.launch.py', vehicle='blanco_table_3_1', duration='5',
                                    start_position='-3.5', seed='7')
    sent = vehicle.options['parameters'][0]
    assert sent['vehicle'] == parameters(estimator)['vehicle'] == 'blanco_table_3_1'
    assert sent['start_position'] == parameters(estimator)['start_position'] == -3.5
    assert (sent['duration'], sent['seed']) == (5.0, 7)
    assert vehicle.options['on_exit']


def test_a_virtual_run_does_not_depend_on_the_case_of_the_parameter_file(tmp_path):
    """The vehicle does not read it: both would have another track or meet on no topic."""
    path = tmp_path / 'mine.yaml'
    path.write_text('/**:\n  ros__parameters:\n    track: mine\n    start_position: 5.0\n'
                    '    speed_topic: elsewhere\n')
    _, [estimator, vehicle] = start('virtual.launch.py', params_file=str(path))
    found, sent = parameters(estimator), vehicle.options['parameters'][0]
    for name in ('track', 'vehicle', 'start_position'):
        assert found[name] == sent[name]
    assert (found['acceleration_topic'], found['speed_topic']) == ('axle_box_acceleration', 'speed')


@pytest.mark.parametrize('name', FILES)
def test_every_value_that_is_passed_on_is_a_parameter_of_the_estimator(name):
    from railtrack_ros.node.track_estimator import SETTINGS

    _, [estimator, *_] = start(name, **{'bag': 'x'} if 'replay' in name else {'track': 'y'})
    known = {item.name: item.kind for item in SETTINGS} | {'use_sim_time': bool}
    for key, value in estimator.options['parameters'][1].items():
        assert type(value) is known[key]


def test_a_parameter_file_that_is_not_there_is_refused_by_name(tmp_path):
    """rcl would only tell that it cannot be opened."""
    with pytest.raises(InputError, match='params_file: there is no file .*nowhere'):
        start('live.launch.py', params_file=str(tmp_path / 'nowhere.yaml'))


def test_the_virtual_vehicle_knows_all_that_it_is_given():
    from railtrack_ros.node.virtual_vehicle import SETTINGS

    _, [_, vehicle] = start('virtual.launch.py', recording='run.mcap', track='blanco_table_3_1')
    known = {item.name: item.kind for item in SETTINGS}
    for name, value in vehicle.options['parameters'][0].items():
        assert type(value) is known[name]


def test_a_replay_plays_the_inputs_only_and_on_the_time_of_the_recording():
    _, [estimator, player] = start('replay.launch.py', bag='run.mcap', rate='2', namespace='coach7',
                                   acceleration_topic='daq/boxes')
    words = player.options['cmd']
    assert words[1:4] == ['-m', 'railtrack_ros.cli.main', 'play']
    assert words[4:] == ['run.mcap', '--rate', '2.0', '--wait-for', '/coach7/track_estimator',
                         '--topics', '/daq/boxes', '/speed']
    found = parameters(estimator)
    assert found['use_sim_time'] is True
    # Whatever its namespace, the node listens to the topics of the recording.
    assert (found['acceleration_topic'], found['speed_topic']) == ('/daq/boxes', '/speed')


@pytest.mark.parametrize('name', ['replay.launch.py', 'virtual.launch.py'])
def test_a_run_ends_when_either_of_its_processes_ends(name):
    _, started = start(name, **{'bag': 'run.mcap'} if 'replay' in name else {})
    assert len(started) == 2
    kind = sys.modules['launch.actions'].Shutdown
    assert all(isinstance(action, kind) for process in started
               for action in process.options['on_exit'])
    assert all(process.options['on_exit'] for process in started)


@pytest.mark.parametrize(('name', 'value'), [('start_position', 'there'), ('use_sim_time', '1')])
def test_an_argument_of_the_wrong_kind_is_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        start('live.launch.py', **{name: value})
