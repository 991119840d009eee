"""Parameters of the nodes: declared once, with description, unit and range, checked in words."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import Setting
from railtrack_ros.parameters import ANY, Range, suggest

# Parameters that rclpy declares or that are declared with the topic they belong to.
OTHERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')

TYPE_WORDS = {
    bool: 'true or false',
    int: 'a whole number',
    float: 'a number with a decimal point, such as 2.0',
    str: 'text',
}


def setting(name: str, default: Any, description: str, unit: str = '', allowed: Range = ANY,
            choices: tuple[str, ...] = ()) -> Setting:
    """Return the declaration of a parameter that belongs to a node alone."""
    return Setting(name, type(default), default, description, unit, allowed, choices)


def declare(node: Node, settings: Iterable[Setting], fixed: Sequence[str] = ()) -> None:
    """Declare parameters on a node.

    Parameters
    ----------
    node
        The node, with the values that the command line and parameter files give it.
    settings
        What to declare.
    fixed
        Names of those that cannot be changed after the start.

    Raises
    ------
    InputError
        A value of the wrong type or out of range; it names the parameter and what was expected.
    """
    for item in settings:
        try:
            value = node.declare_parameter(
                item.name, item.default, _descriptor(item, item.name in fixed)).value
        except InvalidParameterTypeException:
            raise InputError(
                f'parameter {item.name}: expected {TYPE_WORDS[item.kind]}') from None
        except InvalidParameterValueException:
            given = getattr(node, '_parameter_overrides', {}).get(item.name)
            shown = '' if given is None else f', got {given.value!r}'
            raise InputError(f'parameter {item.name}: expected {_expected(item)}{shown}') from None
        check(item, value)


def check(item: Setting, value: Any) -> None:
    """Raise InputError, naming the parameter, for a value that a setting cannot take."""
    if item.kind is str and not item.choices:
        return
    try:
        item.check(value)
    except InputError as error:
        raise InputError(f'parameter {error}') from None


def values(node: Node, settings: Iterable[Setting]) -> dict[str, Any]:
    """Return the values of declared parameters by name."""
    return {item.name: node.get_parameter(item.name).value for item in settings}


def unknown(node: Node) -> list[str]:
    """Return a sentence for each parameter that was given to the node but is none of its own."""
    # rclpy keeps what was given but never declared to itself and says nothing about it.
    given: Mapping[str, Any] = getattr(node, '_parameter_overrides', {})
    own = [name for name in node.get_parameters_by_prefix('') if not name.startswith(OTHERS)]
    return [
        f'parameter {name} is unknown and has no effect; {suggest(name, sorted(own))}'
        for name in given if name not in own and not name.startswith(OTHERS)
    ]


def _expected(item: Setting) -> str:
    if item.choices:
        return f'one of {", ".join(item.choices)}'
    if item.kind in (int, float):
        return f'{item.range} {item.unit}'.strip()
    return TYPE_WORDS[item.kind]


def _descriptor(item: Setting, fixed: bool) -> ParameterDescriptor:
    unit = f' [{item.unit}]' if item.unit else ''
    descriptor = ParameterDescriptor(description=item.description + unit, read_only=fixed)
    if item.choices:
        descriptor.additional_constraints = f'one of {", ".join(item.choices)}'
    low = max(item.range.above, item.range.minimum)
    high = min(item.range.below, item.range.maximum)
    if math.isfinite(low) or math.isfinite(high):
        # The ranges of a descriptor are closed on both sides; these words tell a limit that is not.
        descriptor.additional_constraints = _expected(item)
        if item.kind is float:
            largest = sys.float_info.max
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=max(low, -largest), to_value=min(high, largest), step=0.0)]
        if item.kind is int:
            largest = 2**63 - 1
            descriptor.integer_range = [IntegerRange(
                from_value=int(max(low, -largest)), to_value=int(min(high, largest)), step=1)]
    return descriptor
