"""A recording played through the live estimator.

    ros2 launch railtrack_ros replay.launch.py bag:=run.mcap rate:=2 vehicle:=measurement_coach
"""

import sys

from launch import LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction, Shutdown

from railtrack_ros.node import launching
from railtrack_ros.node.launching import Argument

PLAYER = (
    Argument('bag', 'the recording: an MCAP file or a rosbag2 folder', None),
    Argument('rate', 'times as fast as it was recorded', '1'),
)


def nodes(context):
    """Only the inputs are played: results in the recording would mix with the new ones."""
    given = launching.values(context, (*PLAYER, *launching.ESTIMATOR))
    topics = [given[name] if given[name].startswith('/') else f'/{given[name]}'
              for name in ('acceleration_topic', 'speed_topic')]
    player = ExecuteProcess(
        cmd=[sys.executable, '-m', 'railtrack_ros.cli.main', 'play', given['bag'],
             '--rate', given['rate'], '--topics', *topics],
        output='screen',
        on_exit=[Shutdown(reason='the recording is over')],
    )
    return [launching.estimator(context, use_sim_time=True), player]


def generate_launch_description():
    return LaunchDescription([
        *launching.declared((*PLAYER, *launching.ESTIMATOR)),
        OpaqueFunction(function=nodes),
    ])
