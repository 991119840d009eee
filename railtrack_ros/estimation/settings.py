"""The settings of the estimator and of the indicators, each declared once.

A field's metadata hold its description, unit and range. Validation, the options of the commands,
the parameters of the node and the documentation are all made from this one declaration.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from dataclasses import dataclass, field
from typing import Any

from railtrack_ros.errors import InputError
from railtrack_ros.parameters import ANY, NOT_NEGATIVE, Range
from railtrack_ros.track.bay import LOCAL_SYSTEMS, Mesh


@dataclass(frozen=True)
class Setting:
    """One setting as it was declared; `kind` is bool, int, float or str."""

    name: str
    kind: type
    default: Any
    description: str
    unit: str
    range: Range
    choices: tuple[str, ...]

    def check(self, value: Any) -> Any:
        """Return the value in the setting's kind.

        Raises
        ------
        InputError
            Another type, not finite, outside the range or not one of the choices.
        """
        if self.kind is bool:
            if not isinstance(value, bool):
                raise InputError(f'{self.name}: expected true or false, got {value!r}')
            return value
        if self.kind is str:
            if not self.choices and isinstance(value, str) and value:
                return value
            if value not in self.choices:
                if not self.choices:
                    raise InputError(f'{self.name}: expected text, got {value!r}')
                raise InputError(
                    f'{self.name}: expected one of {", ".join(self.choices)}, got {value!r}'
                )
            return value
        try:
            number = self.kind(value)
            fits = not isinstance(value, (bool, str)) and number == value and number in self.range
        except (TypeError, ValueError, OverflowError):
            fits = False
        if not fits:
            expected = str(self.range) + (f' {self.unit}' if self.unit else '')
            if self.kind is int:
                expected = expected.replace('a number', 'a whole number')
            raise InputError(f'{self.name}: expected {expected}, got {value!r}')
        return number


def setting_field(
    default: Any,
    description: str,
    unit: str = '',
    allowed: Range = ANY,
    choices: tuple[str, ...] = (),
) -> Any:
    """Return the field of a dataclass that :func:`declared` makes a setting of."""
    metadata = {'description': description, 'unit': unit, 'range': allowed, 'choices': choices}
    return field(default=default, metadata=metadata)


def declared(settings: type) -> tuple[Setting, ...]:
    """Return the settings that a class of this module declares, in order."""
    kinds = typing.get_type_hints(settings)
    return tuple(
        Setting(name=f.name, kind=kinds[f.name], default=f.default, **f.metadata)
        for f in dataclasses.fields(settings)
    )


class _Checked:
    """Checks every field against its declaration when an object is made."""

    def __post_init__(self) -> None:
        for setting in declared(type(self)):
            object.__setattr__(self, setting.name, setting.check(getattr(self, setting.name)))


@dataclass(frozen=True)
class EstimatorSettings(_Checked):
    """Everything that the estimate depends on besides the track, the vehicle and the data."""

    start_position: float = setting_field(
        0.0,
        'track position of the reference point at the first sample; sleeper centres lie at '
        'multiples of the sleeper spacing, so it also fixes the phase of the sleepers',
        'm',
        Range(minimum=-1e7, maximum=1e7),
    )
    cut_on_wavelength: float = setting_field(
        3.0,
        'cut-on of the irregularity: causal Butterworth high-pass of order 4 in wavelength',
        'm',
        Range(minimum=0.1, maximum=30.0),
    )
    minimum_speed: float = setting_field(
        1.0,
        'below this speed no irregularity is estimated',
        'm/s',
        Range(minimum=0.1, maximum=20.0),
    )
    input_includes_gravity: bool = setting_field(
        False, 'the sensors report +9.81 m/s2 at rest (REP-145), which is subtracted'
    )
    speed_delay: float = setting_field(
        0.02,
        'a block uses the speed messages stamped up to its end minus this delay, which is the '
        'time that speed messages have to arrive',
        's',
        Range(minimum=0.0, maximum=1.0),
    )
    speed_timeout: float = setting_field(
        2.5,
        'longest time over which the speed is extrapolated; beyond it nothing is estimated',
        's',
        Range(minimum=0.05, maximum=60.0),
    )
    gap_tolerance: float = setting_field(
        0.002,
        'a block whose stamp is off the expected time by more than this starts the estimate anew',
        's',
        Range(minimum=1e-5, maximum=0.1),
    )
    maximum_frequency: float = setting_field(
        4500.0,
        'track modes up to this frequency are followed one by one, the rest all together',
        'Hz',
        Range(minimum=500.0, maximum=20000.0),
    )
    bays_in_ring: int = setting_field(
        0,
        'sleeper bays of the periodic track; 0: as many as the vehicle and the decay of the track '
        'need',
        '',
        Range(minimum=0, maximum=501),
    )
    elements_per_bay: int = setting_field(
        6,
        'rail elements between two sleepers, those over the pad included',
        '',
        Range(minimum=4, maximum=32),
    )
    local_system: str = setting_field(
        'dynamic',
        'what represents the rail inside its elements',
        choices=LOCAL_SYSTEMS,
    )

    @property
    def mesh(self) -> Mesh:
        """The finite-element mesh from which the track modes are computed."""
        return Mesh(elements_per_bay=self.elements_per_bay, local_system=self.local_system)


@dataclass(frozen=True)
class IndicatorSettings(_Checked):
    """How the irregularity is summed up in sections of track."""

    section_length: float = setting_field(
        10.0,
        'length of a section; sections begin at its multiples',
        'm',
        Range(minimum=1.0, maximum=1000.0),
    )
    minimum_valid: float = setting_field(
        0.5,
        'a figure of a section is given if at least this share of the section is valid for it',
        '',
        Range(above=0.0, maximum=1.0),
    )
    minimum_prominence: float = setting_field(
        9.0,
        'a dominant wavelength is named if its level above the ISO 3095 spectrum exceeds the '
        'median over all wavelengths by this, which random irregularity hardly ever does',
        'dB',
        NOT_NEGATIVE,
    )
    bands: str = setting_field(
        '10-30,30-100,100-300,300-1000',
        'bands of wavelength in mm, each SHORTEST-LONGEST, separated by commas',
    )
    limits: str = setting_field(
        'grassie_1999',
        'limits by which a section is OK, WARN or ERROR: a shipped set or a YAML file',
    )

    def __post_init__(self) -> None:
        """Check the bands, too."""
        super().__post_init__()
        self.wavelengths  # noqa: B018

    @property
    def wavelengths(self) -> tuple[tuple[float, float], ...]:
        """The bands as (shortest, longest) wavelength [m].

        Raises
        ------
        InputError
            Text that is no list of bands, or a band outside 2 mm to 10 m or under half an octave.
        """
        bands = []
        for text in self.bands.split(','):
            try:
                shortest, longest = (1e-3 * float(part) for part in text.split('-'))
            except ValueError:
                shortest = longest = math.nan
            if not (0.002 <= shortest < shortest * 1.41 <= longest <= 10.0):
                raise InputError(
                    f'bands: expected SHORTEST-LONGEST,... in mm between 2 and 10000, each of at '
                    f'least half an octave, such as 30-100,100-300; got {text.strip()!r}'
                )
            bands.append((round(shortest, 6), round(longest, 6)))
        if len(set(bands)) < len(bands):
            raise InputError(f'bands: expected each band once, got {self.bands!r}')
        return tuple(bands)
