"""What the launch files have in common: arguments with descriptions, and the estimator's node."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from launch import LaunchContext  # type: ignore[attr-defined]  # the folder of that name
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from railtrack_ros.errors import InputError
from railtrack_ros.paths import config_directory

PACKAGE = 'railtrack_ros'


@dataclass(frozen=True)
class Argument:
    """An argument of a launch file.

    `kind` is bool, float, int or str. One that is left empty is not passed on, so that what the
    parameter file says stays. One whose default is None has to be given.
    """

    name: str
    description: str
    default: str | None = ''
    kind: type = str

    def read(self, text: str) -> Any:
        """Return the value in its kind, None where it was left empty."""
        text = text.strip()
        if not text:
            return None
        if self.kind is bool:
            if text.lower() not in ('true', 'false'):
                raise InputError(f'{self.name}: expected true or false, got {text!r}')
            return text.lower() == 'true'
        try:
            return self.kind(text)
        except ValueError:
            raise InputError(f'{self.name}: expected a number, got {text!r}') from None


PARAMETER_FILE = Argument(
    'params_file', 'YAML file with parameters of the estimator',
    str(config_directory() / 'estimator.yaml'))
NAMESPACE = Argument('namespace', 'namespace of nodes and input topics, one for each vehicle')
ACCELERATION_TOPIC = Argument(
    'acceleration_topic', 'topic of the axle-box acceleration', 'axle_box_acceleration')
SPEED_TOPIC = Argument('speed_topic', 'topic of the speed', 'speed')
TRACK = Argument('track', 'shipped track or YAML file (empty: as the parameter file says)')
VEHICLE = Argument('vehicle', 'shipped vehicle or YAML file (empty: as the parameter file says)')
START_POSITION = Argument(
    'start_position', 'track position at the first sample, m (empty: as the parameter file says)',
    kind=float)
USE_SIM_TIME = Argument('use_sim_time', 'take the time from /clock', 'false', bool)
LOG_LEVEL = Argument('log_level', 'debug, info, warn or error', 'info')

ESTIMATOR = (PARAMETER_FILE, NAMESPACE, ACCELERATION_TOPIC, SPEED_TOPIC, TRACK, VEHICLE,
             START_POSITION, USE_SIM_TIME, LOG_LEVEL)


def declared(arguments: Iterable[Argument]) -> list[DeclareLaunchArgument]:
    """Return the actions that declare arguments."""
    return [
        DeclareLaunchArgument(argument.name, default_value=argument.default,
                              description=argument.description)
        for argument in arguments
    ]


def values(context: LaunchContext, arguments: Iterable[Argument]) -> dict[str, Any]:
    """Return the values that arguments have in a launch; those left empty are not among them."""
    read = {
        argument.name: argument.read(LaunchConfiguration(argument.name).perform(context))
        for argument in arguments
    }
    return {name: value for name, value in read.items() if value is not None}


def estimator(context: LaunchContext, **overrides: Any) -> Node:
    """Return the node `track_estimator` with the arguments of :data:`ESTIMATOR`."""
    given = {**values(context, ESTIMATOR), **overrides}
    parameters = ('track', 'vehicle', 'start_position', 'use_sim_time')
    return Node(
        package=PACKAGE,
        executable='track_estimator',
        name='track_estimator',
        namespace=given.get('namespace', ''),
        output='screen',
        parameters=[given['params_file'], {k: given[k] for k in parameters if k in given}],
        remappings=_remappings(given),
        arguments=['--ros-args', '--log-level', given['log_level']],
    )


def _remappings(given: Mapping[str, Any]) -> list[tuple[str, str]]:
    usual = {ACCELERATION_TOPIC: 'axle_box_acceleration', SPEED_TOPIC: 'speed'}
    return [(name, given[argument.name]) for argument, name in usual.items()
            if given.get(argument.name, name) != name]
