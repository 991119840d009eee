"""What package.xml, setup.py and the requirement files say agrees with what is there."""

import ast
import os
import re
import runpy
import shutil
import stat
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import setuptools

import railtrack_ros

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'railtrack_ros'
SHARE = 'share/railtrack_ros'

pytestmark = pytest.mark.skipif(not (ROOT / 'setup.py').exists(), reason='needs the source tree')


@pytest.fixture(scope='module')
def described():
    return ElementTree.parse(ROOT / 'package.xml').getroot()


@pytest.fixture(scope='module')
def declared():
    """Return what setup.py passes to setuptools."""
    passed = {}
    original, before = setuptools.setup, os.getcwd()
    setuptools.setup = lambda **arguments: passed.update(arguments)
    try:
        os.chdir(ROOT)
        runpy.run_path(str(ROOT / 'setup.py'))
    finally:
        setuptools.setup = original
        os.chdir(before)
    return passed


def installed_files(declared):
    return {
        f'{folder}/{Path(file).name}': ROOT / file
        for folder, files in declared['data_files']
        for file in files
    }


def imported_modules():
    """Return the top-level names that the modules of the package import."""
    names = set()
    for path in PACKAGE.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
                names.add(node.module.split('.')[0])
    return names - set(sys.stdlib_module_names) - {'railtrack_ros'}


def test_the_package_description_is_complete(described):
    assert described.get('format') == '3'
    assert described.findtext('name') == 'railtrack_ros'
    assert described.findtext('export/build_type') == 'ament_python'
    assert re.fullmatch(r'[^@\s]+@[^@\s]+\.[a-z]{2,}', described.find('maintainer').get('email'))
    assert described.findtext('license') == 'Apache-2.0'
    assert 'Apache License' in (ROOT / described.find('license').get('file')).read_text()
    for tag in ('version', 'description', 'maintainer'):
        assert described.findtext(tag).strip()


def test_there_is_one_version(described, declared):
    assert railtrack_ros.__version__ == described.findtext('version') == declared['version']
    assert re.fullmatch(r'\d+\.\d+\.\d+', railtrack_ros.__version__)


def test_catkin_pkg_accepts_the_package_description():
    package = pytest.importorskip('catkin_pkg.package')
    warnings = []
    package.parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    assert warnings == []


@pytest.mark.parametrize('folder', ['config', 'launch', 'bags'])
def test_every_shipped_file_is_installed_where_it_is_looked_for(declared, folder):
    installed = installed_files(declared)
    for path in (ROOT / folder).rglob('*'):
        if path.is_file() and '__pycache__' not in path.parts and not path.name.startswith('.'):
            assert installed[f'{SHARE}/{path.relative_to(ROOT).as_posix()}'] == path


def test_ros_finds_the_package(declared):
    installed = installed_files(declared)
    assert f'{SHARE}/package.xml' in installed
    marker = installed['share/ament_index/resource_index/packages/railtrack_ros']
    assert marker.read_text() == ''


def test_every_installed_file_exists(declared):
    assert [path for path in installed_files(declared).values() if not path.is_file()] == []


def test_every_folder_with_modules_is_an_installed_package(declared):
    folders = {path.parent for path in PACKAGE.rglob('*.py')}
    names = {'.'.join(folder.relative_to(ROOT).parts) for folder in folders}
    assert names == set(declared['packages'])


def test_files_that_the_program_reads_beside_its_modules_are_installed(declared):
    patterns = declared['package_data']['railtrack_ros']
    installed = {path for pattern in patterns for path in PACKAGE.glob(pattern)}
    beside = {
        path
        for path in PACKAGE.rglob('*')
        if path.is_file() and '__pycache__' not in path.parts and path.suffix != '.py'
    }
    assert beside == installed


def test_executables_go_where_ros_looks_for_them(declared):
    settings = (ROOT / 'setup.cfg').read_text()
    assert settings.count('=$base/lib/railtrack_ros') == 2
    scripts = dict(
        re.split(r'\s*=\s*', line) for line in declared['entry_points']['console_scripts']
    )
    assert {'railtrack', 'track_estimator', 'virtual_vehicle'} <= set(scripts)
    for target in scripts.values():
        module, function = target.split(':')
        path = ROOT / f'{module.replace(".", "/")}.py'
        tree = ast.parse(path.read_text(encoding='utf-8'))
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_colcon_installs_executables_that_find_their_files(tmp_path):
    pytest.importorskip('colcon_core')
    source = tmp_path / 'src'
    for name in ('railtrack_ros', 'config', 'launch', 'bags', 'resource'):
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, source / name, ignore=shutil.ignore_patterns('__pycache__')
            )
    for name in ('package.xml', 'setup.py', 'setup.cfg', 'pyproject.toml'):
        shutil.copy(ROOT / name, source)
    environment = {**os.environ, 'AMENT_PREFIX_PATH': sys.prefix}
    build = subprocess.run(
        [sys.executable, '-m', 'colcon', 'build'],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert build.returncode == 0, build.stderr
    installed = tmp_path / 'install' / 'railtrack_ros'
    shutil.rmtree(source)

    executables = {path.name for path in (installed / 'lib' / 'railtrack_ros').iterdir()}
    assert {'railtrack', 'track_estimator', 'virtual_vehicle'} <= executables
    assert (installed / SHARE / 'config' / 'tracks' / 'blanco_table_3_1.yaml').is_file()
    (packages,) = installed.glob('**/railtrack_ros/paths.py')
    code = 'from railtrack_ros import paths; print(paths.config_directory())'
    found = subprocess.run(
        [sys.executable, '-c', code],
        cwd=tmp_path,
        env={**environment, 'PYTHONPATH': str(packages.parents[1])},
        capture_output=True,
        text=True,
    )
    assert found.stdout.strip() == str(installed / SHARE / 'config'), found.stderr


def test_every_imported_distribution_is_declared_and_pinned(declared, described):
    distributions = {'yaml': 'PyYAML'}
    depends = {element.text for element in described.findall('exec_depend')}
    required = {re.split(r'[<>=]', line)[0] for line in declared['install_requires']}
    pinned = (ROOT / 'requirements' / 'runtime.txt').read_text()
    for module in imported_modules() - depends:
        name = distributions.get(module, module)
        assert name in required, f'{module}: in neither package.xml nor install_requires'
        assert re.search(rf'^{name}==', pinned, re.MULTILINE), f'{name} is not pinned'


def test_every_requirement_is_pinned_exactly():
    for path in (ROOT / 'requirements').glob('*.txt'):
        for line in path.read_text().splitlines():
            if line and not line.startswith(('#', '--only-binary', '--no-binary')):
                assert re.fullmatch(r'[A-Za-z0-9_.-]+(\[\w+\])?==[\w.]+', line), f'{path}: {line}'


def test_the_targets_are_listed_by_make():
    result = subprocess.run(['make', '-C', str(ROOT)], capture_output=True, text=True)
    assert result.returncode == 0
    for target in ('setup', 'demo', 'test', 'lint', 'bench', 'clean'):
        assert re.search(rf'^make {target} +\w', result.stdout, re.MULTILINE)


def test_continuous_integration_runs_the_tests():
    run = ROOT / '.ci' / 'run'
    assert run.stat().st_mode & stat.S_IXUSR
    assert run.read_text().rstrip().endswith('exec make test')
