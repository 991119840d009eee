"""Corrugation indicators of a recording that holds an estimate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from railtrack_ros.bags.bag import Bag, open_bag
from railtrack_ros.bags.codec import WAVEFORM, decode_waveform
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.indicators import (
    COLUMNS,
    HasAxleBoxes,
    Section,
    SectionIndicators,
)
from railtrack_ros.estimation.settings import IndicatorSettings
from railtrack_ros.output import write_csv
from railtrack_ros.runs import configuration
from railtrack_ros.runs.configuration import Configuration
from railtrack_ros.runs.estimate import NODE
from railtrack_ros.runs.results import CONFIGURATION
from railtrack_ros.vehicle.description import Vehicle

IRREGULARITY = 'irregularity'


@dataclass(frozen=True)
class Indicated:
    """The sections, sorted by axle box and place, and what was wrong with the input."""

    sections: list[Section]
    defects: list[str]


def indicators(
    bag: str | Path,
    settings: IndicatorSettings | None = None,
    vehicle: Vehicle | None = None,
    topic: str | None = None,
    progress: Callable[[float, float], None] = lambda done, total: None,
) -> Indicated:
    """Sum up the irregularity of a recording in sections.

    Parameters
    ----------
    bag
        A recording of the estimator, live or offline.
    settings
        How sections are made.
    vehicle
        Its axle boxes; None: as the recording tells.
    topic
        Waveform of irregularity with positions; None: that of the estimator.
    progress
        Called with the seconds that are done, and all of them.

    Raises
    ------
    InputError
        No estimate in the recording, axle boxes that are not known, or no section that could be
        resolved.
    """
    with open_bag(bag) as opened:
        topic = irregularity_topic(opened, topic)
        known = _configuration(opened, topic)
        layout = _layout(opened, known, vehicle)
        stream = SectionIndicators(layout, settings, known.estimator if known else None)
        sections: list[Section] = []
        defects: list[str] = []
        start, total = opened.start_time, (opened.end_time - opened.start_time) / 1e9
        names: set[str] = set()
        for message in opened.messages({topic}):
            seconds = (message.log_time - start) / 1e9
            try:
                block = decode_waveform(opened.decode(message))
                if block.position is None:
                    raise InputError(f'{topic}: has no field position')
            except InputError as error:
                defects.append(f'{bag}: message at {seconds:.3f} s: {error}')
                continue
            names.update(block.channels)
            sections += stream.feed(block.t, block.position, block.channels)
            progress(seconds, total)
        sections += stream.finish()
        defects += [f'{bag}: {note}' for note in opened.notes]
    order = {box.name: number for number, box in enumerate(layout.axle_boxes)}
    if not names.intersection(order):
        listed = ', '.join(sorted(names)) or 'none'
        raise InputError(
            f'{bag}: {topic} has none of the axle boxes {", ".join(order)}; its channels are: '
            f'{listed}'
        )
    if not sections:
        raise InputError(
            f'{bag}: no section of {stream.settings.section_length:g} m has enough valid '
            f'irregularity on {topic}; try shorter sections'
        )
    sections.sort(key=lambda section: (order[section.axle_box], section.start))
    return Indicated(sections, defects)


def write_sections(path: str | Path, sections: Sequence[Section]) -> None:
    """Write sections as CSV; what could not be resolved is empty."""
    rows = [section.row() for section in sections]
    write_csv(path, {name: [row[name] for row in rows] for name in COLUMNS})


def irregularity_topic(bag: Bag, wanted: str | None) -> str:
    """Return the topic of the irregularity.

    Raises
    ------
    InputError
        There is none, or more than one.
    """
    if wanted is not None:
        return bag.topic(wanted, wanted, (WAVEFORM,), IRREGULARITY)
    usual = f'{NODE}/{IRREGULARITY}'
    found = [
        topic.name
        for topic in bag.topics.values()
        if topic.type == WAVEFORM
        and topic.name.endswith(f'/{IRREGULARITY}')
        and not topic.name.startswith('/truth/')
    ]
    if usual in found:
        return usual
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(
            f'{bag.path}: the irregularity may be any of {", ".join(found)}; say which with --topic'
        )
    raise InputError(
        f'{bag.path}: no {usual} in the recording; compute it first: '
        f'railtrack estimate {bag.path} --track T --vehicle V --output OUT.mcap'
    )


def _configuration(bag: Bag, topic: str) -> Configuration | None:
    """Return what the recording says of its estimate."""
    name = f'{topic.rsplit("/", 1)[0]}/{CONFIGURATION}'
    if name not in bag.topics or bag.topics[name].type != configuration.TYPE:
        return None
    for message in bag.messages({name}):
        text = bag.decode(message).data
        return configuration.read_configuration(text, f'{bag.path}: {name}')
    return None


def _layout(bag: Bag, known: Configuration | None, vehicle: Vehicle | None) -> HasAxleBoxes:
    if vehicle is not None:
        return vehicle
    if known is None:
        raise InputError(
            f'{bag.path}: the recording does not tell where the axle boxes are; say it with '
            '--vehicle'
        )
    return known
