"""What results were computed with, as a text that travels with them.

The estimator's results come with a `std_msgs/msg/String` on `~/configuration`: YAML with the
software version, track, vehicle and settings. A recording so tells where its axle boxes are.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import yaml

from railtrack_ros import __version__
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import AxleBox, Vehicle

TYPE = 'std_msgs/msg/String'


@dataclass(frozen=True)
class Configuration:
    """What the indicators need to know of the estimate."""

    axle_boxes: tuple[AxleBox, ...]
    estimator: EstimatorSettings
    indicators: IndicatorSettings


def write_configuration(
    track: Track, vehicle: Vehicle, estimator: EstimatorSettings, indicators: IndicatorSettings
) -> str:
    """Return the text."""
    content = {
        'software': f'railtrack_ros {__version__}',
        'vehicle': asdict(vehicle),
        'track': asdict(track),
        'estimator': asdict(estimator),
        'indicators': asdict(indicators),
    }
    return yaml.safe_dump(_plain(content), sort_keys=False)


def read_configuration(text: str, source: str) -> Configuration:
    """Return what a text says; settings that this version does not know are left out.

    Raises
    ------
    InputError
        The text is not such a configuration; `source` names where it is from.
    """
    try:
        content = yaml.safe_load(text)
        return Configuration(
            tuple(AxleBox(**box) for box in content['vehicle']['axle_boxes']),
            EstimatorSettings(**_known(EstimatorSettings, content['estimator'])),
            IndicatorSettings(**_known(IndicatorSettings, content['indicators'])),
        )
    except (yaml.YAMLError, KeyError, TypeError, InputError) as error:
        raise InputError(f'{source}: is no configuration of the estimator ({error})') from error


def _known(settings: type, values: dict[str, Any]) -> dict[str, Any]:
    names = settings.__dataclass_fields__  # type: ignore[attr-defined]
    return {name: value for name, value in values.items() if name in names}


def _plain(value: Any) -> Any:
    """Return a value in lists, mappings and built-in types alone."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value
