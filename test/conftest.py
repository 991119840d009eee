"""Environment and cases shared by the tests.

The environment is set here, before anything imports rclpy or numba.
"""

import atexit
import os
import shutil
import signal
import tempfile
import zlib

import pytest

# Wrong field types in a message are an error, not a silently corrupted message.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['NUMBA_NUM_THREADS'] = '1'
os.environ['MPLBACKEND'] = 'agg'

ROS_LOG = tempfile.mkdtemp(prefix='railtrack_ros_log_')
atexit.register(shutil.rmtree, ROS_LOG, ignore_errors=True)
os.environ['ROS_LOG_DIR'] = ROS_LOG

# A shell without job control starts what runs in its background deaf to Ctrl-C, children too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Domains 1 to 100: one for each worker of a run, likely others for another run beside it.
RUN = os.environ.get('PYTEST_XDIST_TESTRUNUID', str(os.getpid()))
WORKER = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
os.environ['ROS_DOMAIN_ID'] = str(1 + (zlib.crc32(RUN.encode()) + WORKER) % 100)


@pytest.fixture(scope='session')
def table_2_1():
    from railtrack_ros.track.description import load_track

    return load_track('blanco_table_2_1')


@pytest.fixture(scope='session')
def table_3_1():
    from railtrack_ros.track.description import load_track

    return load_track('blanco_table_3_1')


@pytest.fixture(scope='session')
def reference_data():
    """Return the folder of reference data that is not shipped; skip the test without it."""
    from railtrack_ros.paths import reference_data

    folder = reference_data()
    if folder is None:
        pytest.skip('no reference data: set RAILTRACK_DATA')
    return folder
