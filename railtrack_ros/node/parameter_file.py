"""The parameter file of the estimator, config/estimator.yaml, written from the declarations."""

from __future__ import annotations

import math
import textwrap

from railtrack_ros.estimation.settings import Setting
from railtrack_ros.node.settings import SETTINGS
from railtrack_ros.parameters import Range

HEAD = """\
# Parameters of the node track_estimator with their defaults: copy, change, and give to the node
# with --ros-args --params-file FILE. A parameter that the node does not know is told by name.
# Written by: python -m railtrack_ros.node.parameter_file > config/estimator.yaml
/**:
  ros__parameters:
"""


def text() -> str:
    """Return the file."""
    return HEAD + ''.join(_entry(setting) for setting in SETTINGS)


def _entry(setting: Setting) -> str:
    remarks = [setting.unit, _limits(setting.range), ' | '.join(setting.choices)]
    remark = ', '.join(part for part in remarks if part)
    words = setting.description + (f' [{remark}]' if remark else '')
    lines = textwrap.wrap(words, 94, initial_indent='    # ', subsequent_indent='    # ')
    return '\n'.join([*lines, f'    {setting.name}: {_value(setting.default)}']) + '\n'


def _limits(allowed: Range) -> str:
    sides = ((allowed.above, '>'), (allowed.minimum, '>='), (allowed.maximum, '<='),
             (allowed.below, '<'))
    return ', '.join(f'{sign}{limit:g}' for limit, sign in sides if math.isfinite(limit))


def _value(default: object) -> str:
    if isinstance(default, bool):
        return str(default).lower()
    return str(default) or "''"


if __name__ == '__main__':
    print(text(), end='')
