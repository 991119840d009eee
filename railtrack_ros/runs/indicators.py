"""Corrugation indicators of a recording that holds an estimate."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from railtrack_ros.bags.bag import Bag, open_bag
from railtrack_ros.bags.codec import WAVEFORM
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.analysis import Analysis, TrackAnalysis
from railtrack_ros.estimation.indicators import HasAxleBoxes, SectionIndicators
from railtrack_ros.estimation.section import Judge, Section
from railtrack_ros.estimation.settings import IndicatorSettings
from railtrack_ros.runs import configuration
from railtrack_ros.runs.configuration import Configuration
from railtrack_ros.runs.estimate import NODE
from railtrack_ros.runs.indicator_tables import Geography, Places, write_table
from railtrack_ros.runs.indicator_waveforms import waveform_table
from railtrack_ros.runs.results import CONFIGURATION
from railtrack_ros.vehicle.description import Vehicle

IRREGULARITY = 'irregularity'
FIX = 'sensor_msgs/msg/NavSatFix'

FILTERS = ('causal', 'zero-phase')


@dataclass(frozen=True)
class Indicated:
    """What was found in a recording.

    sections: by axle box and place, through the causal filters or those without delay as asked.
    defects: what was wrong with the input. analysis: of the rails, where it was asked for; judge:
    its settings and limits. content: what the recording says it was computed with (the YAML of
    its configuration), empty if nothing. geography: places by position, as the recording tells.
    """

    sections: list[Section]
    defects: list[str]
    judge: Judge
    analysis: Analysis | None = None
    content: Mapping[str, Any] = field(default_factory=dict)
    geography: Geography | None = None


def indicators(
    bag: str | Path,
    settings: IndicatorSettings | None = None,
    vehicle: Vehicle | None = None,
    topic: str | None = None,
    progress: Callable[[float, float], None] = lambda done, total: None,
    filters: str = 'causal',
    analyse: bool = False,
    waveforms: str | Path | None = None,
) -> Indicated:
    """Sum up the irregularity of a recording in sections.

    Parameters
    ----------
    bag
        A recording of the estimator, live or offline.
    settings
        How sections are made.
    vehicle
        Its axle boxes and wheels; None: as the recording tells.
    topic
        Waveform of irregularity with positions; None: that of the estimator.
    progress
        Called with the seconds that are done, and all of them.
    filters
        Of the sections: 'causal', the numbers of the live node, or 'zero-phase'.
    analyse
        Whether to analyse the rails, too: wheels set apart, axle boxes fused.
    waveforms
        Table (.csv, .parquet) into which the rails' band-limited waveforms are written as they
        come; only with `analyse`.

    Raises
    ------
    InputError
        No estimate in the recording, axle boxes that are not known, or no section that could be
        resolved.
    """
    with open_bag(bag) as opened, contextlib.ExitStack() as stack:
        topic = irregularity_topic(opened, topic)
        known, content = _configuration(opened, topic)
        layout = _layout(opened, known, vehicle)
        estimator = known.estimator if known else None
        stream = SectionIndicators(layout, settings, estimator)
        analysis = None
        if analyse or filters == 'zero-phase':
            radius = vehicle.wheel.radius if vehicle else _wheel_radius(content)
            take = None
            if analyse and waveforms is not None:
                rails = list(dict.fromkeys(box.rail for box in layout.axle_boxes))
                take = stack.enter_context(waveform_table(waveforms, rails, stream.judge.bands))
            analysis = TrackAnalysis(
                layout, settings, estimator, stream.judge.limits, radius if analyse else None,
                take)
        sections: list[Section] = []
        defects: list[str] = []
        start, total = opened.start_time, (opened.end_time - opened.start_time) / 1e9
        names: set[str] = set()
        places = Places()
        fixes = {name for name, item in opened.topics.items() if item.type == FIX}
        for message in opened.messages({topic, *fixes}):
            seconds = (message.log_time - start) / 1e9
            try:
                if message.topic in fixes:
                    places.add_fix(opened.decode(message))
                    continue
                block = opened.waveform(message)
                if block.position is None:
                    raise InputError(f'{topic}: has no field position')
            except InputError as error:
                defects.append(f'{bag}: message at {seconds:.3f} s: {error}')
                continue
            names.update(block.channels)
            places.add_position(block.stamp_ns, float(block.position[0]))
            if filters == 'causal':
                sections += stream.feed(
                    block.t, block.position, block.channels, block.stamp_ns)
            if analysis is not None:
                analysis.feed(block.t, block.position, block.channels, block.stamp_ns)
            progress(seconds, total)
        sections += stream.finish()
        found = analysis.finish() if analysis is not None else None
        if found is not None and filters == 'zero-phase':
            sections = found.combined
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
    return Indicated(sections, defects, stream.judge, found if analyse else None, content,
                     places.geography())


def write_sections(path: str | Path, sections: Sequence[Section]) -> None:
    """Write sections as a table, to the last digit; what could not be resolved is empty."""
    write_table(path, [section.row() for section in sections], exact=True)


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


def _configuration(bag: Bag, topic: str) -> tuple[Configuration | None, dict[str, Any]]:
    """Return what the recording says of its estimate, checked and as it stands there."""
    name = f'{topic.rsplit("/", 1)[0]}/{CONFIGURATION}'
    if name not in bag.topics or bag.topics[name].type != configuration.TYPE:
        return None, {}
    for message in bag.messages({name}):
        text = bag.decode(message).data
        known = configuration.read_configuration(text, f'{bag.path}: {name}')
        return known, yaml.safe_load(text)
    return None, {}


def _wheel_radius(content: Mapping[str, Any]) -> float | None:
    radius = content.get('vehicle', {}).get('wheel', {}).get('radius')
    return float(radius) if isinstance(radius, (int, float)) else None


def _layout(bag: Bag, known: Configuration | None, vehicle: Vehicle | None) -> HasAxleBoxes:
    if vehicle is not None:
        return vehicle
    if known is None:
        raise InputError(
            f'{bag.path}: the recording does not tell where the axle boxes are; say it with '
            '--vehicle'
        )
    return known
