"""A recording played through the live estimator.

    ros2 launch railtrack_ros replay.launch.py bag:=run.mcap rate:=2 vehicle:=measurement_coach
"""

import sys

from launch import LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction, Shutdown

from railtrack_ros.node import launching
from railtrack_ros.node.launching import Argument
from railtrack_ros.node.processes import transport

PLAYER = (
    Argument('bag', 'the recording: an MCAP file or a rosbag2 folder', None),
    Argument('rate', 'times as fast as it was recorded', '1', float),
    Argument('acceleration_topic', 'topic of the axle-box acceleration in the recording',
             '/axle_box_acceleration'),
    Argument('speed_topic', 'topic of the speed in the recording', '/speed'),
)


def nodes(context):
    """Only the inputs are played: results in the recording would mix with the new ones."""
    given = launching.values(context, (*PLAYER, *launching.COMMON))
    # Absolute names: a namespace is for the results, the recording has the names that it has.
    topics = {name: f'/{given[name].strip("/")}' for name in ('acceleration_topic', 'speed_topic')}
    parameters = launching.values(context, launching.CASE)
    estimator = launching.estimator(
        given, {**parameters, **topics, 'use_sim_time': True},
        on_exit=[Shutdown(reason='the estimator has ended')])
    namespace = given.get('namespace', '').strip('/')
    name = f'/{namespace}/track_estimator' if namespace else '/track_estimator'
    player = ExecuteProcess(
        cmd=[sys.executable, '-m', 'railtrack_ros.cli.main', 'play', given['bag'],
             '--rate', str(given['rate']), '--wait-for', name,
             '--topics', *topics.values()],
        name='player',
        output='screen',
        additional_env=transport(),
        on_exit=[Shutdown(reason='the recording is over')],
    )
    return [estimator, player]


def generate_launch_description():
    return LaunchDescription([
        *launching.declared((*PLAYER, *launching.CASE, *launching.COMMON)),
        OpaqueFunction(function=nodes),
    ])
