"""The documentation: links, generated pages, the map of equations, and every command in it.

All commands are checked for their arguments. Those of the pages in RUN are really run too, in the
order of their page, in a folder with the files that the page names, lengths cut short where an
option sets them (SHORTER); all but those that start a live system or take minutes (PARSED). Not
run are docs/recordings.md, which has placeholders, and docs/reference/commands.md.
"""

import importlib
import importlib.util
import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from railtrack_ros.cli.main import COMMANDS, available, main
from railtrack_ros.errors import InputError

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / 'docs'
PAGES = sorted([*ROOT.glob('*.md'), *DOCS.rglob('*.md'), *(ROOT / 'bags').glob('*.md')])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
LINK = re.compile(r'\]\(([^)\s]+)\)')
FENCE = re.compile(r'^ *```(\w*)\n(.*?)^ *```', re.MULTILINE | re.DOTALL)
OWN = re.compile(r'\s*(?:railtrack|make|ros2 launch|\.venv/bin/\w+) ')
INDENTED = re.compile(r'(?:^    (?:railtrack|make|ros2|\.venv/bin/)(?:.*\n)(?:^        .*\n)*)+',
                      re.MULTILINE)

# Only parsed: live processes (tested in test_demo, test_node_processes, test_live_equals_offline),
# and measurements and pages that take minutes (test_figures, benchmarks).
PARSED = {'demo', 'play', 'benchmark', 'figures'}
# What is computed is the same; only less of it.
SHORTER = {'--duration': 1.0, '--distance': 2.0}
# Programs that are not this project's: nothing to check.
FOREIGN = {'cd', 'git', 'pip', 'colcon', '.', 'cp', 'export', 'sh', 'python', 'ros2', 'source',
           'sudo', 'apt', 'echo', 'mkdir', 'ls', 'cat', 'kill', 'taskset', 'chrt', 'ulimit'}
NODES = {'track_estimator', 'virtual_vehicle', 'recorder'}


def generator():
    return runpy.run_path(str(DOCS / 'generate.py'))


def blocks(page):
    """Shell blocks of a page: fenced as sh, bash, shell or console, or commands in others."""
    text = (ROOT / page).read_text(encoding='utf-8')
    for language, block in FENCE.findall(text):
        if language in ('sh', 'bash', 'shell', 'console'):
            yield re.sub(r'^\s*\$ ', '', block, flags=re.MULTILINE)
        elif language in ('', 'text'):
            lines = re.sub(r'\\\n\s*', ' ', block).splitlines()
            yield '\n'.join(line for line in lines if OWN.match(line))
    for match in INDENTED.finditer(FENCE.sub('', text)):
        yield match[0]


def commands(page):
    """Command lines of a page's shell blocks, continued lines joined, comments off."""
    for block in blocks(page):
        for line in re.sub(r'\\\n\s*', ' ', block).splitlines():
            for part in re.split(r'\s(?:&&|\|)\s', line):
                try:
                    words = shlex.split(part, comments=True)
                except ValueError:
                    words = part.split()
                while words and re.fullmatch(r'[A-Z_]+=\S*', words[0]):
                    words = words[1:]
                if words and words[-1] == '&':
                    words = words[:-1]
                if words:
                    yield [words[0].rpartition('/')[2] or words[0], *words[1:]]


def railtrack_commands(page):
    return [words[1:] for words in commands(page) if words[0] == 'railtrack']


# --- links ------------------------------------------------------------------------------------

@pytest.mark.parametrize('page', NAMES)
def test_every_link_leads_to_a_file_of_the_source(page):
    for target in LINK.findall((ROOT / page).read_text(encoding='utf-8')):
        if '://' in target or target.startswith('#'):
            continue
        assert ((ROOT / page).parent / target.partition('#')[0]).exists(), target


def test_the_documentation_builds_without_warnings(tmp_path):
    if importlib.util.find_spec('mkdocs') is None:
        pytest.skip('mkdocs is not installed (requirements/dev.txt)')
    result = subprocess.run(
        [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir', str(tmp_path / 'site')],
        cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert 'WARNING' not in result.stderr
    assert (tmp_path / 'site' / 'validation.html').is_file()


# --- generated pages --------------------------------------------------------------------------

@pytest.mark.parametrize('name', ['commands.md', 'parameters.md'])
def test_generated_reference_is_that_of_the_program(name):
    pytest.importorskip('rclpy')
    text = generator()['PAGES'][name]()
    same = text == (DOCS / 'reference' / name).read_text(encoding='utf-8')
    assert same, f'docs/reference/{name} is out of date: run python docs/generate.py (or make docs)'


def test_topic_reference_names_every_topic_of_the_estimator():
    text = (DOCS / 'reference' / 'topics.md').read_text(encoding='utf-8')
    for topic in ('axle_box_acceleration', 'speed', 'set_position', 'contact_force',
                  'rail_deflection', 'irregularity', 'corrugation', 'diagnostics', 'rms_10_30',
                  'rms_30_100', 'rms_100_300', 'rms_300_1000'):
        assert topic in text


def test_validation_page_has_every_figure_and_its_picture():
    from railtrack_ros.figures.catalogue import CATALOGUE

    text = (DOCS / 'validation.md').read_text(encoding='utf-8')
    for entry in CATALOGUE:
        assert f'### Figure {entry.number}\n' in text
        assert f'](figures/{entry.stem}.png)' in text
    pictures = list((DOCS / 'figures').glob('*.png'))
    assert sum(path.stat().st_size for path in pictures) < 3e6


def test_citation_names_this_version():
    from railtrack_ros import __version__

    yaml = pytest.importorskip('yaml')
    cited = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert cited['version'] == __version__
    assert cited['license'] == 'Apache-2.0'


# --- the map of equations ---------------------------------------------------------------------

def rows_of_the_map():
    for line in (DOCS / 'map.md').read_text(encoding='utf-8').splitlines():
        match = re.match(r'\| \((\d)\.(\d+)\) \|', line)
        if match:
            cells = [cell.strip() for cell in line.strip('|').split('|')]
            yield (int(match[1]), int(match[2])), cells


def test_the_map_leaves_no_equation_of_the_thesis_out():
    expected = [(chapter, n) for chapter, last in ((2, 31), (3, 23), (4, 8))
                for n in range(1, last + 1)]
    assert [number for number, _ in rows_of_the_map()] == expected


def test_the_map_names_functions_that_exist():
    for number, (_, _, name, _) in rows_of_the_map():
        parts = ['railtrack_ros', *name.strip('`').split('.')]
        for split in range(len(parts), 0, -1):
            module = '.'.join(parts[:split])
            try:
                found = importlib.import_module(module)
                break
            except ModuleNotFoundError:
                continue
        assert split > 2, f'{number}: {name}'
        for part in parts[split:]:
            assert hasattr(found, part), f'{number}: {name}'
            found = getattr(found, part)
        assert callable(found), f'{number}: {name}'


def test_the_map_names_tests_that_exist():
    for number, (_, _, _, name) in rows_of_the_map():
        file, _, test = name.strip('`').partition('::')
        text = (ROOT / 'test' / file).read_text(encoding='utf-8')
        assert re.search(rf'^def {test}\(', text, re.MULTILINE), f'{number}: {name}'


# --- commands ---------------------------------------------------------------------------------

def test_every_command_of_the_program_is_in_the_reference():
    text = (DOCS / 'reference' / 'commands.md').read_text(encoding='utf-8')
    assert set(available()) == set(COMMANDS)
    assert all(f'## railtrack {name}\n' in text for name in COMMANDS)


@pytest.mark.parametrize('page', NAMES)
def test_every_line_of_a_page_is_a_known_program_with_arguments_that_it_takes(page):
    parser = generator()['parser']
    targets = set(re.findall(r'^([a-z]+):', (ROOT / 'Makefile').read_text(encoding='utf-8'),
                             re.MULTILINE))
    for program, *arguments in commands(page):
        if program == 'railtrack':
            if arguments == ['--help'] or arguments == ['--version']:
                continue
            name, *rest = arguments
            assert name in COMMANDS, arguments
            if '--help' in rest:
                continue
            try:
                parser(name).parse_args(rest)
            except InputError as error:
                pytest.fail(f'railtrack {" ".join(arguments)}: {error}')
        elif program == 'make':
            assert {word for word in arguments if '=' not in word} <= targets, arguments
        elif program == 'ros2' and arguments[:1] == ['launch']:
            launch_file = ROOT / 'launch' / arguments[2]
            assert launch_file.is_file(), arguments
            assert {word.partition(':=')[0] for word in arguments[3:] if ':=' in word} <= (
                launch_arguments(launch_file)), arguments
        elif program == 'python' and arguments[0] != '-m':
            assert (ROOT / arguments[0]).is_file(), arguments
        else:
            assert program in FOREIGN | NODES, (program, arguments)


@pytest.mark.parametrize('page', NAMES)
def test_commands_named_within_a_sentence_exist_with_the_options_named(page):
    text = FENCE.sub('', (ROOT / page).read_text(encoding='utf-8'))
    parser = generator()['parser']
    for span in re.findall(r'`(?:\.venv/bin/)?(railtrack [a-z][^`]*|ros2 launch [^`]*)`', text):
        program, *words = span.split()
        if program == 'ros2':
            if len(words) > 2 and words[1] == 'railtrack_ros':
                assert (ROOT / 'launch' / words[2]).is_file(), span
                assert {word.partition(':=')[0] for word in words if ':=' in word} <= (
                    launch_arguments(ROOT / 'launch' / words[2])), span
            continue
        assert words[0].strip(',.') in COMMANDS, span
        known = {option for action in parser(words[0].strip(',.'))._actions
                 for option in action.option_strings}
        named = {re.split(r'[=,]', word)[0] for word in words if word.startswith('--')}
        assert named <= known, span


def launch_arguments(path):
    """Names of the arguments that a launch file and what it shares declare."""
    shared = ROOT / 'railtrack_ros' / 'node' / 'launching.py'
    return {name for file in (path, shared) for name in
            re.findall(r"Argument\(\s*'(\w+)'", file.read_text(encoding='utf-8'))}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with what a reader of the documentation has."""
    for name in ('bags', 'config', 'benchmarks'):
        (tmp_path / name).symlink_to(ROOT / name)
    for name, source in (('my_track.yaml', 'tracks/mainline_soft_pads.yaml'),
                         ('my_coach.yaml', 'vehicles/measurement_coach.yaml')):
        (tmp_path / name).write_text((ROOT / 'config' / source).read_text(encoding='utf-8'),
                                     encoding='utf-8')
    t = np.arange(4000) / 2000.0
    rng = np.random.default_rng(1)
    columns = np.column_stack([t, 72.0 + 0.0 * t, *rng.normal(0.0, 0.3, (2, t.size))])
    np.savetxt(tmp_path / 'measurement.csv', columns, delimiter=',', fmt='%.6f',
               header='time,v,acc_1,acc_2', comments='')
    assert main(['import', str(tmp_path / 'measurement.csv'), '--channels',
                 'acc_1=axle1_left,acc_2=axle1_right', '--sample-rate', '2000', '--speed', '20',
                 str(tmp_path / 'run.mcap')]) == 0
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shortened(arguments):
    """The same command over less time or track."""
    result = list(arguments)
    for option, most in SHORTER.items():
        if option in result:
            at = result.index(option) + 1
            result[at] = str(min(float(result[at]), most))
    return result


RUN = ['README.md', 'bags/README.md', 'docs/tutorial.md', 'docs/track_model.md',
       'docs/full_model.md', 'docs/corrugation.md',
       *(name for name in NAMES if name.startswith('docs/how_to/'))]


REPLAYED: set[tuple[str, ...]] = set()  # the same replay of another page is not done again


@pytest.mark.parametrize('page', RUN)
def test_commands_of_a_page_do_what_they_say(page, folder, capsys):
    done = set()
    if page == 'docs/corrugation.md':  # begins with a recording that is estimated
        assert main(['estimate', 'bags/corrugated_two_wheels.mcap', '--track',
                     'mainline_soft_pads', '--vehicle', 'bags/two_wheels.yaml', '--output',
                     'estimate.mcap']) == 0
    for name, *rest in railtrack_commands(page):
        if name in PARSED or name.startswith('--') or '--help' in rest:
            continue
        arguments = shortened([name, *rest])
        if name == 'replay' and tuple(arguments) in REPLAYED:
            continue
        REPLAYED.add(tuple(arguments))
        status = main(arguments)
        error = capsys.readouterr().err
        # 3: done, with defects of the input named; the measurement here has six of eight boxes
        # missing and is noise.
        defective = 'run.mcap' in rest or 'result.mcap' in rest
        assert status == 0 or (status == 3 and defective), (arguments, error)
        for option in ('--output', '--plot', '--report'):
            if option in rest:
                made = folder / rest[rest.index(option) + 1]
                assert made.is_file() or (made / 'report.html').is_file(), made
        done.add(name)
    if page == 'README.md':
        assert done >= {'info', 'estimate', 'indicators', 'replay', 'import', 'decay-rate',
                        'resonances'}


def test_the_tutorial_finds_the_corrugation_that_it_speaks_of(folder, capsys):
    for arguments in railtrack_commands('docs/tutorial.md')[1:3]:
        assert main([*arguments, '--json']) == 0
    json.loads(capsys.readouterr().out.partition('\n}\n')[0] + '\n}')
    lines = (folder / 'indicators.csv').read_text(encoding='utf-8').splitlines()
    rows = [dict(zip(lines[0].split(','), line.split(','), strict=True)) for line in lines[1:]]
    inside = [row for row in rows if float(row['from_m']) >= 31 and float(row['to_m']) <= 49.9]
    assert inside
    for row in inside:
        assert float(row['rms_30_100_um']) == pytest.approx(14.1, rel=0.15)
        assert float(row['dominant_wavelength_m']) == pytest.approx(0.045, rel=0.05)
