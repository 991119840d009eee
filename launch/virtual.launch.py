"""A virtual vehicle and the estimator, for trying things out without a train.

    ros2 launch railtrack_ros virtual.launch.py duration:=60 corrugation:=0.045:20e-6:200:260:left
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction, Shutdown

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

# Not left to the parameter file: both nodes shall have the same.
CASE = (
    Argument('track', 'shipped track or YAML file', 'mainline_soft_pads'),
    Argument('vehicle', 'shipped vehicle or YAML file', 'measurement_coach'),
    Argument('start_position', 'track position at the first sample, m', '0', float),
)

# The first start on a machine compiles, s.
PATIENCE = 600.0


def nodes(context):
    given = launching.values(context, launching.COMMON)
    case = launching.values(context, CASE)
    vehicle = launching.node(
        given, 'virtual_vehicle', [{**launching.values(context, RUN), **case,
                                    'patience': PATIENCE}],
        on_exit=[Shutdown(reason='the run is over')])
    estimator = launching.estimator(
        given, {**case, 'acceleration_topic': 'axle_box_acceleration', 'speed_topic': 'speed'},
        on_exit=[Shutdown(reason='the estimator has ended')])
    return [estimator, vehicle]


def generate_launch_description():
    return LaunchDescription([
        *launching.declared((*RUN, *CASE, *launching.COMMON)),
        OpaqueFunction(function=nodes),
    ])
