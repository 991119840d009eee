"""The frame of the command line: help, exit status, and errors of one line."""

import importlib
import json
import os
import subprocess
import sys
import types

import numpy as np
import pytest

from railtrack_ros import __version__
from railtrack_ros.cli import common, main
from railtrack_ros.errors import InputError


def railtrack(*arguments, **environment):
    return subprocess.run(
        [sys.executable, '-m', 'railtrack_ros.cli.main', *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, **environment},
    )


@pytest.fixture
def command(monkeypatch):
    """Put a command in place of `info` that does what the test says."""

    def put(run, add_arguments=lambda parser: None):
        module = types.ModuleType('railtrack_ros.cli.info')
        module.EXAMPLE = 'railtrack info run.mcap'
        module.add_arguments = add_arguments
        module.run = run
        module.__spec__ = types.SimpleNamespace(name=module.__name__)
        monkeypatch.setitem(sys.modules, module.__name__, module)

    return put


def fail(error):
    def run(args):
        raise error

    return run


def test_help_lists_every_command_that_is_here(capsys):
    assert main.main(['--help']) == 0
    told = capsys.readouterr().out
    for name in main.available():
        assert f'  {name} ' in told
        assert main.COMMANDS[name] in told


def test_help_is_given_without_importing_ros_or_the_models():
    code = (
        'import sys\n'
        'from railtrack_ros.cli.main import main\n'
        "assert main(['--help']) == 0\n"
        "print(sorted({'rclpy', 'numpy', 'numba', 'scipy'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert result.stdout.splitlines()[-1] == '[]', result.stderr


def test_version(capsys):
    assert main.main(['--version']) == 0
    assert capsys.readouterr().out == f'railtrack {__version__}\n'


@pytest.mark.parametrize('name', main.available())
def test_help_of_every_command_ends_with_an_example_of_it(name, capsys):
    with pytest.raises(SystemExit) as end:
        main.main([name, '--help'])
    assert end.value.code == 0
    told = capsys.readouterr().out
    assert '--json' in told
    assert told.rstrip().split('example:\n  ')[1].startswith(f'railtrack {name}')


@pytest.mark.parametrize('name', main.available())
def test_every_command_refuses_an_unknown_option_in_one_line(name, capsys):
    assert main.main([name, '--no-such-option']) == 2
    told = capsys.readouterr()
    assert told.out == ''
    assert told.err.startswith(f'railtrack {name}: ')
    assert told.err.count('\n') == 1


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ([], 'railtrack: name a command'),
        (['nonsense'], "railtrack: unknown command 'nonsense'; expected one of "),
        (['--nonsense'], "railtrack: unknown command '--nonsense'"),
        ([''], "railtrack: unknown command ''"),
        (['../main'], "railtrack: unknown command '../main'"),
        (['common'], "railtrack: unknown command 'common'"),
    ],
)
def test_what_is_no_command_is_refused_in_one_line(arguments, message, capsys):
    assert main.main(arguments) == 2
    told = capsys.readouterr()
    assert told.out == ''
    assert told.err.startswith(message)
    assert told.err.count('\n') == 1


def test_a_mistyped_command_suggests_the_one_that_was_meant(command, capsys):
    command(fail(AssertionError()))
    assert main.main(['inof']) == 2
    assert "did you mean 'info'?" in capsys.readouterr().err


def test_lines_are_for_people_and_json_for_programs(command, capsys):
    summary = {
        'rate': np.float64(2.5),
        'gaps': np.int64(3),
        'mean': np.array([1.0, np.nan]),
        'nested': {'peak': float('inf'), 'path': main.__name__, 'none': None, 'ok': np.bool_(True)},
    }
    command(lambda args: main.Outcome(summary, ['2.5 Hz', '3 gaps']))
    assert main.main(['info']) == 0
    assert capsys.readouterr().out == '2.5 Hz\n3 gaps\n'
    assert main.main(['info', '--json']) == 0
    assert json.loads(capsys.readouterr().out) == {
        'rate': 2.5,
        'gaps': 3,
        'mean': [1.0, None],
        'nested': {'peak': None, 'path': main.__name__, 'none': None, 'ok': True},
    }


def test_defects_of_the_input_are_told_and_make_exit_status_3(command, capsys):
    command(lambda args: main.Outcome({}, ['done'], ['axle1_left: 12 samples are NaN']))
    assert main.main(['info']) == 3
    told = capsys.readouterr()
    assert told.out == 'done\n'
    assert told.err == 'railtrack info: axle1_left: 12 samples are NaN\n'


def test_remarks_are_told_and_leave_exit_status_0(command, capsys):
    command(lambda args: main.Outcome({}, ['done'], remarks=['gap of 0.1 s']))
    assert main.main(['info']) == 0
    told = capsys.readouterr()
    assert told.out == 'done\n'
    assert told.err == 'railtrack info: gap of 0.1 s\n'


def parser_of(name):
    module = importlib.import_module(main.module_name(name))
    parser = main.Parser()
    module.add_arguments(parser)
    return parser


def test_what_a_command_writes_is_known_to_the_check_for_overwriting():
    written = {'OUT', 'OUT.mcap', 'FILE.csv', 'FILE.html', 'DIR'}
    for name in main.available():
        for action in parser_of(name)._actions:
            known = action.dest in common.OUTPUTS
            assert known or action.metavar not in written, (name, action.dest)
            # What is read is in CSV, a BAG or a FILE by position; every other FILE is written.
            assert known or action.metavar != 'FILE' or not action.option_strings, (
                name, action.dest)


@pytest.mark.parametrize('arguments', [
    ['indicators', 'in.x', '--output', 'in.x'],
    ['indicators', 'in.x', '--output', 'out.csv', '--grind-list', './in.x'],
    ['indicators', 'in.x', '--output', 'out.csv', '--wheels', 'link.x'],
    ['indicators', 'other.x', '--geography', 'in.x', '--output', 'in.x'],
    ['simulate', '--track', 'in.x', '--vehicle', 'v', '--speed', '9', '--output', 'in.x'],
    ['simulate', '--track', 't', '--vehicle', 'in.x', '--speed', '9', '--output', 'hard.x'],
    ['simulate', '--track', 't', '--vehicle', 'v', '--speed', '9', '--irregularity', 'sine:1:1e-6',
     '--irregularity', 'in.x', '--output', 'in.x'],
    ['simulate', '--track', 't', '--vehicle', 'v', '--speed-file', 'in.x', '--output', 'in.x'],
    ['receptance', '--track', 'in.x', '--at', '0', '--frequencies', '9', '--output', 'in.x'],
    ['decay-rate', '--track', 'in.x', '--output', 'out.csv', '--plot', 'in.x'],
    ['dispersion', '--track', 'in.x', '--frequencies', '9', '--output', 'in.x'],
    ['resonances', '--track', 't', '--vehicle', 'in.x', '--output', 'in.x'],
    ['import', 'in.x', '--channels', 'a=b', 'in.x'],
    ['synthesize', '--track', 't', '--vehicle', 'v', '--duration', '1', '--speed', '9', '--seed',
     '1', '--roughness', 'in.x', 'in.x'],
    ['estimate', 'in.x', '--track', 't', '--vehicle', 'v', '--output', 'out.mcap', '--report',
     'in.x'],
    ['estimate', 'folder', '--track', 't', '--vehicle', 'v', '--output', 'folder/x.mcap'],
    ['compare', 'other.x', 'folder', '--output', 'folder'],
    ['decay-rate', '--track', 't', '--output', 'same.png', '--plot', './same.png'],
])
def test_no_output_replaces_an_input_or_another_output(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'in.x').write_text('measured once')
    (tmp_path / 'link.x').symlink_to('in.x')
    (tmp_path / 'hard.x').hardlink_to(tmp_path / 'in.x')
    before = sorted(tmp_path.iterdir())
    assert main.main(arguments) == 2
    told = capsys.readouterr().err
    assert told.count('\n') == 1
    assert told.endswith(('choose another output\n', 'choose another for one of them\n'))
    assert (tmp_path / 'in.x').read_text() == 'measured once'
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ('error', 'status', 'message'),
    [
        (InputError('a.yaml: rail.area:\n missing key'), 2, 'a.yaml: rail.area: missing key'),
        (KeyboardInterrupt(), 130, 'interrupted'),
        (ZeroDivisionError('by\nzero'), 1, 'ZeroDivisionError: by zero (RAILTRACK_DEBUG=1 sho'),
        (MemoryError(), 1, 'MemoryError:'),
    ],
)
def test_every_error_is_one_line_and_an_exit_status(command, capsys, error, status, message):
    command(fail(error))
    assert main.main(['info', '--json']) == status
    told = capsys.readouterr()
    assert told.out == ''
    assert told.err.startswith(f'railtrack info: {message}')
    assert told.err.count('\n') == 1


def test_the_traceback_is_there_for_those_who_ask(command, capsys, monkeypatch):
    monkeypatch.setenv('RAILTRACK_DEBUG', '1')
    command(fail(ZeroDivisionError('by zero')))
    assert main.main(['info']) == 1
    told = capsys.readouterr().err
    assert 'Traceback' in told
    assert told.endswith('railtrack info: ZeroDivisionError: by zero\n')


def test_a_reader_that_has_gone_is_no_error_message():
    code = 'import sys; from railtrack_ros.cli.main import main; sys.exit(main(["--help"]))'
    reading, writing = os.pipe()
    os.close(reading)
    result = subprocess.run(
        [sys.executable, '-c', code], stdout=writing, stderr=subprocess.PIPE, text=True
    )
    os.close(writing)
    assert result.returncode == 141
    assert result.stderr == ''


def test_the_exit_status_reaches_the_shell():
    result = railtrack('nonsense')
    assert result.returncode == 2
    assert result.stderr.count('\n') == 1
    assert 'Traceback' not in result.stderr


MODEL = ['--track', 'blanco_table_3_1']


@pytest.fixture
def model(command):
    """Run `info` with the model options and return its track and mesh."""
    made = []

    def add_arguments(parser):
        common.add_track(parser)
        common.add_model_options(parser)

    def run(args):
        made.append(common.model(args))
        return main.Outcome({})

    def model(*options):
        command(run, add_arguments)
        status = main.main(['info', *options])
        return made[-1] if status == 0 else status

    return model


def test_without_options_the_track_is_that_of_the_file(model, table_3_1):
    track, mesh = model(*MODEL)
    assert track == table_3_1
    assert mesh == type(mesh)()


def test_model_options_replace_what_the_file_says(model, table_3_1):
    track, mesh = model(
        *MODEL, '--support', 'concentrated', '--loss-factor', '1e-2', '--local-system', 'none',
        '--elements-per-bay', '6', '--elements-per-pad', '4',
    )  # fmt: skip
    assert track.support.kind == 'concentrated'
    assert track.rail.loss_factor == 0.01
    assert track.support.pad_stiffness == table_3_1.support.pad_stiffness
    assert (mesh.local_system, mesh.elements_per_bay, mesh.elements_per_pad) == ('none', 6, 4)


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--track', 'nonsense'], "unknown track 'nonsense'"),
        ([], 'the following arguments are required: --track'),
        ([*MODEL, '--support', 'slab'], "argument --support: invalid choice: 'slab'"),
        ([*MODEL, '--loss-factor', 'nan'], 'argument --loss-factor: expected a number of at least'),
        ([*MODEL, '--loss-factor', '-0.1'], '--loss-factor: expected a number of at least 0'),
        ([*MODEL, '--loss-factor', 'inf'], '--loss-factor: expected a number of at least 0'),
        ([*MODEL, '--loss-factor', 'two'], "expected a number of at least 0, got 'two'"),
        ([*MODEL, '--elements-per-bay', '0'], 'expected a whole number of at least 1'),
        ([*MODEL, '--elements-per-bay', '2.5'], "expected a whole number of at least 1, got '2.5'"),
        ([*MODEL, '--elements', '4'], 'unrecognized arguments: --elements 4'),
    ],
)
def test_model_options_that_make_no_sense_are_refused_by_name(model, capsys, options, message):
    assert model(*options) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count('\n') == 1


@pytest.mark.parametrize('text', ['-2', '-2.5', '-.5', '-1e3', '-2.5E-3'])
def test_a_negative_number_is_no_option(command, text):
    read = []
    command(
        lambda args: read.append(args.offset) or main.Outcome({}),
        lambda parser: parser.add_argument('--offset', type=common.number()),
    )
    assert main.main(['info', '--offset', text]) == 0
    assert read == [float(text)]


def test_a_progress_bar_is_for_terminals_only(capsys):
    with common.progress(10, 's', 'running') as bar:
        bar.update(10)
    assert bar.disable
    assert capsys.readouterr().err == ''
