"""Acceleration in single samples, each axle box on a topic of its own: which topics these are.

Sensors of up to about 1 kHz send `sensor_msgs/msg/Imu` or `geometry_msgs/msg/AccelStamped`, on
PREFIX/NAME for the axle box NAME, as the node takes them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from railtrack_ros.bags.bag import Bag
from railtrack_ros.bags.codec import ACCELERATION, IMU
from railtrack_ros.errors import InputError

SINGLES = (IMU, ACCELERATION)


def sample_topics(
    bag: Bag, wanted: str | None, usual: str, names: Collection[str] | None
) -> tuple[str, Mapping[str, str]] | None:
    """Return the prefix of single samples and the axle box by topic; None where there are none.

    Parameters
    ----------
    wanted
        Prefix that was asked for, or None.
    usual
        Prefix to prefer if nothing was asked for.
    names
        Of the axle boxes; None: whatever is there.

    Raises
    ------
    InputError
        Nothing was asked for, and there are several.
    """
    groups: dict[str, dict[str, str]] = {}
    for topic in bag.topics.values():
        prefix, _, name = topic.name.rpartition('/')
        if topic.type in SINGLES and (names is None or name in names):
            groups.setdefault(prefix, {})[topic.name] = name
    prefix = '/' + (wanted or usual).strip('/')
    if prefix in groups:
        return prefix, groups[prefix]
    if wanted is not None:
        return None
    if len(groups) > 1:
        raise InputError(f'{bag.path}: the acceleration may be the single samples under any of '
                         f'{", ".join(groups)}; say which')
    return next(iter(groups.items()), None)
