"""The live system: the estimator on the topics of a measuring system.

    ros2 launch railtrack_ros live.launch.py vehicle:=measurement_coach start_position:=12850
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction

from railtrack_ros.node import launching


def nodes(context):
    return [launching.estimator(context)]


def generate_launch_description():
    return LaunchDescription([
        *launching.declared(launching.ESTIMATOR),
        OpaqueFunction(function=nodes),
    ])
