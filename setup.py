import re
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'railtrack_ros'
HERE = Path(__file__).resolve().parent
SHARE = Path('share') / NAME


def version():
    text = (HERE / NAME / '__init__.py').read_text(encoding='utf-8')
    return re.search(r"^__version__ = '(.+)'$", text, re.MULTILINE).group(1)


def shared(folder):
    """List a folder with its subfolders as data files under share/railtrack_ros."""
    files = {}
    for path in sorted((HERE / folder).rglob('*')):
        hidden = any(part.startswith(('.', '__')) for part in path.relative_to(HERE).parts)
        if path.is_file() and not hidden:
            place = path.relative_to(HERE)
            files.setdefault(str(SHARE / place.parent), []).append(str(place))
    return list(files.items())


setup(
    name=NAME,
    version=version(),
    description='Contact force, rail deflection and irregularity from axle-box acceleration',
    author='The railtrack_ros developers',
    license='Apache-2.0',
    python_requires='>=3.10,<3.14',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['report/*.css', 'report/*.js']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (str(SHARE), ['package.xml']),
        *shared('config'),
        *shared('launch'),
        *shared('bags'),
        *shared('benchmarks'),
    ],
    # What a distribution of ROS ships is enough; requirements/ pins what is tested.
    install_requires=[
        'numpy>=1.26,<3',
        'scipy>=1.11',
        'numba>=0.58',
        'PyYAML>=6.0',
        'rosbags>=0.11',
        'mcap>=1.5',
        'lz4>=4.0',
        'zstandard>=0.22',
        'matplotlib>=3.6',
        'plotly>=5.4',
        'tqdm>=4.66',
        'rich>=12.0',
        'setuptools',  # colcon counts on finding it here
    ],
    # import: HDF5, MAT of version 7.3 and TDMS; nothing else needs these.
    extras_require={
        'import': ['h5py>=3.8', 'npTDMS>=1.7'],
        'parquet': ['pyarrow>=14'],  # tables of indicators
        'test': ['pytest'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'railtrack = railtrack_ros.cli.main:main',
            'track_estimator = railtrack_ros.node.start:track_estimator',
            'virtual_vehicle = railtrack_ros.node.start:virtual_vehicle',
            'recorder = railtrack_ros.node.start:recorder',
        ],
    },
)
