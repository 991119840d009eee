"""A virtual vehicle and the estimator, for trying things out without a train.

    ros2 launch railtrack_ros virtual.launch.py duration:=60 corrugation:=0.045:20e-6:200:260:left
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction, Shutdown
from launch_ros.actions import Node

from railtrack_ros.node import launching
from railtrack_ros.node.launching import Argument

RUN = (
    Argument('duration', 'length of the run, s', '20', float),
    Argument('speed', 'speed at the start, m/s', '25', float),
    Argument('acceleration', 'm/s2, negative to brake', '0', float),
    Argument('roughness', 'none, iso3095 or a CSV file', 'iso3095'),
    Argument('corrugation', 'WAVELENGTH:AMPLITUDE:FROM:TO or WAVELENGTH:AMPLITUDE:FROM:TO:RAIL in '
             'metres, several separated by spaces', '0.045:20e-6:200:260:right'),
    Argument('noise', 'white noise of the accelerometers, m/s2 rms', '0.3', float),
    Argument('seed', 'of roughness and noise', '1', int),
    Argument('recording', 'bag to send in real time instead of a computed run'),
    Argument('loop', 'begin again at the end of the run', 'false', bool),
)


def nodes(context):
    """Both nodes get the same track, vehicle and start position."""
    shared = launching.values(context, launching.ESTIMATOR)
    same = {name: shared[name] for name in ('track', 'vehicle', 'start_position')
            if name in shared}
    vehicle = Node(
        package=launching.PACKAGE,
        executable='virtual_vehicle',
        name='virtual_vehicle',
        namespace=shared.get('namespace', ''),
        output='screen',
        parameters=[{**launching.values(context, RUN), **same}],
        on_exit=[Shutdown(reason='the run is over')],
    )
    return [launching.estimator(context), vehicle]


def generate_launch_description():
    return LaunchDescription([
        *launching.declared((*RUN, *launching.ESTIMATOR)),
        OpaqueFunction(function=nodes),
    ])
