"""The live system: the estimator on the topics of a measuring system.

    ros2 launch railtrack_ros live.launch.py vehicle:=measurement_coach start_position:=12850
"""

from launch import LaunchDescription
from launch.actions import OpaqueFunction

from railtrack_ros.node import launching
from railtrack_ros.node.launching import AS_THE_FILE, Argument

PARAMETERS = (
    *launching.CASE,
    Argument('acceleration_topic', f'topic of the axle-box acceleration {AS_THE_FILE}'),
    Argument('speed_topic', f'topic of the speed {AS_THE_FILE}'),
    Argument('use_sim_time', 'take the time from /clock, as `ros2 bag play --clock` sends it',
             'false', bool),
    Argument('autostart', 'configure and activate at the start; false: wait for `ros2 lifecycle` '
             f'{AS_THE_FILE}', kind=bool),
)
RESPAWN = Argument('respawn', 'start the node again when it has died', 'false', bool)
RESPAWN_DELAY = 1.0  # s


def nodes(context):
    given = launching.values(context, (*launching.COMMON, RESPAWN))
    return [launching.estimator(given, launching.values(context, PARAMETERS),
                                respawn=given['respawn'], respawn_delay=RESPAWN_DELAY)]


def generate_launch_description():
    return LaunchDescription([
        *launching.declared((*PARAMETERS, *launching.COMMON, RESPAWN)),
        OpaqueFunction(function=nodes),
    ])
