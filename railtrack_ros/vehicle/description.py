"""What a vehicle is to the track: unsprung masses under a static load, Hertzian contacts."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from railtrack_ros import parameters, paths
from railtrack_ros.parameters import ANY, NOT_NEGATIVE, POSITIVE, Range, Section

RAILS = ('left', 'right')


@dataclass(frozen=True)
class Suspension:
    """The primary suspension between an axle box and the mass that it carries."""

    stiffness: float  # N/m
    damping: float  # N s/m
    sprung_mass: float  # kg


@dataclass(frozen=True)
class WheelMode:
    """One flexible mode of the wheelset, mass-normalised, as seen at contact and axle box."""

    frequency: float  # Hz
    damping_ratio: float
    contact_shape: float  # 1/sqrt(kg), displacement of the contact point, up positive
    axle_box_shape: float  # 1/sqrt(kg), displacement of the axle box


@dataclass(frozen=True)
class Wheel:
    """One wheel with its share of the unsprung mass."""

    mass: float  # M, unsprung mass per wheel, kg
    static_load: float  # W, the whole static wheel load on the rail, N
    radius: float  # R, m
    suspension: Suspension | None = None
    modes: tuple[WheelMode, ...] = ()


@dataclass(frozen=True)
class Contact:
    """The contact spring: force = stiffness * indentation**exponent, zero when apart."""

    stiffness: float  # K_H, N/m**exponent
    exponent: float  # 1.5: Hertz, 1: linear
    damping: float = 0.0  # N s/m, of the linearised contact at the static load


@dataclass(frozen=True)
class AxleBox:
    """One accelerometer above one wheel."""

    name: str  # also the channel of its acceleration
    rail: str  # 'left' or 'right'
    offset: float  # m from the vehicle's reference point, negative behind it


@dataclass(frozen=True)
class Vehicle:
    """A vehicle of equal wheels."""

    name: str
    wheel: Wheel
    contact: Contact
    axle_boxes: tuple[AxleBox, ...]
    description: str = ''

    @property
    def rails(self) -> tuple[str, ...]:
        """The rails that carry an axle box, left before right."""
        return tuple(rail for rail in RAILS if self.on_rail(rail))

    def on_rail(self, rail: str) -> tuple[AxleBox, ...]:
        """Return the axle boxes on a rail in the order of the file."""
        return tuple(box for box in self.axle_boxes if box.rail == rail)


SUSPENSION_RANGES = {'stiffness': POSITIVE, 'damping': NOT_NEGATIVE, 'sprung_mass': POSITIVE}
MODE_RANGES = {
    'frequency': POSITIVE,
    'damping_ratio': Range(minimum=0.0, below=1.0),
    'contact_shape': ANY,
    'axle_box_shape': ANY,
}
WHEEL_RANGES = {'mass': POSITIVE, 'static_load': POSITIVE, 'radius': POSITIVE}
CONTACT_RANGES = {'stiffness': POSITIVE, 'exponent': Range(minimum=1.0)}

# A name is a field of a waveform message beside t and position, and a token of topic names.
NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,63}')
TAKEN_NAMES = ('t', 'position')


def load_vehicle(name_or_path: str | Path) -> Vehicle:
    """Read a shipped vehicle by its name, or a vehicle file by its path.

    Raises
    ------
    InputError
        No such vehicle, or something in the file is not understood or impossible.
    """
    path = parameters.find_described('vehicle', name_or_path, _folder())
    file = parameters.read_yaml(path)
    file.expect(('wheel', 'contact', 'axle_boxes'), ('description',))

    wheel = file.section('wheel')
    wheel.expect(WHEEL_RANGES, ('suspension', 'modes'))
    suspension = None
    if 'suspension' in wheel:
        section = wheel.section('suspension')
        section.expect(SUSPENSION_RANGES)
        suspension = Suspension(**section.numbers(SUSPENSION_RANGES))
    modes = []
    for section in wheel.sections('modes') if 'modes' in wheel else ():
        section.expect(MODE_RANGES)
        modes.append(WheelMode(**section.numbers(MODE_RANGES)))

    contact = file.section('contact')
    contact.expect(CONTACT_RANGES, ('damping',))
    damping = contact.number('damping', NOT_NEGATIVE) if 'damping' in contact else 0.0

    return Vehicle(
        name=path.stem,
        wheel=Wheel(**wheel.numbers(WHEEL_RANGES), suspension=suspension, modes=tuple(modes)),
        contact=Contact(**contact.numbers(CONTACT_RANGES), damping=damping),
        axle_boxes=_axle_boxes(file.sections('axle_boxes')),
        description=file.text('description', default=''),
    )


def _axle_boxes(entries: list[Section]) -> tuple[AxleBox, ...]:
    boxes: list[AxleBox] = []
    for entry in entries:
        entry.expect(('name', 'rail', 'offset'))
        box = AxleBox(
            name=entry.text('name'),
            rail=entry.choice('rail', RAILS),
            offset=entry.number('offset', ANY),
        )
        if not NAME.fullmatch(box.name) or box.name in TAKEN_NAMES:
            raise entry.error(
                'name',
                f'{box.name!r} cannot name a channel and a topic: expected a letter, then up to '
                f'63 letters, digits or underscores, and neither of {", ".join(TAKEN_NAMES)}',
            )
        for other in boxes:
            if other.name == box.name:
                raise entry.error('name', f'{box.name!r} is the name of an axle box above')
            if (other.rail, other.offset) == (box.rail, box.offset):
                raise entry.error(
                    'offset',
                    f'{box.name!r} is where {other.name!r} is: {box.rail} rail, {box.offset:g} m',
                )
        boxes.append(box)
    return tuple(boxes)


def shipped_vehicles() -> list[str]:
    """Return the names of the vehicles that come with the program."""
    return parameters.shipped_names(_folder())


def _folder() -> Path:
    return paths.config_directory() / 'vehicles'
