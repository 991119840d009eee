"""What the launch files have in common: arguments with descriptions, and the estimator's node."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from launch import LaunchContext  # type: ignore[attr-defined]  # the folder of that name
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from railtrack_ros.errors import InputError
from railtrack_ros.node.processes import transport
from railtrack_ros.paths import config_directory

PACKAGE = 'railtrack_ros'


@dataclass(frozen=True)
class Argument:
    """An argument of a launch file.

    `kind` is bool, float, int or str. One that is left empty is not passed on, so that what the
    parameter file says stays. One whose default is None has to be given. `choices` are the only
    values, where there are any.
    """

    name: str
    description: str
    default: str | None = ''
    kind: type = str
    choices: tuple[str, ...] = ()

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


AS_THE_FILE = '(empty: as the parameter file says)'

PARAMETER_FILE = Argument(
    'params_file', 'YAML file with parameters of the estimator',
    str(config_directory() / 'estimator.yaml'))
NAMESPACE = Argument('namespace', 'namespace of nodes and input topics, one for each vehicle')
LOG_LEVEL = Argument('log_level', 'what the nodes say', 'info',
                     choices=('debug', 'info', 'warn', 'error'))
TRACK = Argument('track', f'shipped track or YAML file {AS_THE_FILE}')
VEHICLE = Argument('vehicle', f'shipped vehicle or YAML file {AS_THE_FILE}')
START_POSITION = Argument(
    'start_position', f'track position at the first sample, m {AS_THE_FILE}', kind=float)

# What every launch file takes, and the case in all of them that have no virtual vehicle.
COMMON = (PARAMETER_FILE, NAMESPACE, LOG_LEVEL)
CASE = (TRACK, VEHICLE, START_POSITION)


def declared(arguments: Iterable[Argument]) -> list[DeclareLaunchArgument]:
    """Return the actions that declare arguments."""
    return [
        DeclareLaunchArgument(argument.name, default_value=argument.default,
                              description=argument.description,
                              choices=list(argument.choices) or None)
        for argument in arguments
    ]


def values(context: LaunchContext, arguments: Iterable[Argument]) -> dict[str, Any]:
    """Return the values that arguments have in a launch; those left empty are not among them."""
    read = {
        argument.name: argument.read(LaunchConfiguration(argument.name).perform(context))
        for argument in arguments
    }
    return {name: value for name, value in read.items() if value is not None}


def estimator(given: dict[str, Any], parameters: dict[str, Any], **options: Any) -> Node:
    """Return the node `track_estimator`.

    Parameters
    ----------
    given
        Values of the arguments :data:`COMMON`.
    parameters
        On top of those of the parameter file.
    options
        Further ones of the action.
    """
    file = given['params_file']
    if not Path(file).is_file():
        raise InputError(f'params_file: there is no file {file}')
    return node(given, 'track_estimator', [file, parameters], **options)


def node(given: dict[str, Any], name: str, parameters: list[Any], **options: Any) -> Node:
    """Return a node of this package in the namespace and with the log level that were given."""
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        namespace=given.get('namespace', ''),
        output='screen',
        parameters=parameters,
        ros_arguments=['--log-level', given['log_level']],
        additional_env=transport(),
        **options,
    )
