"""Layouts of PlotJuggler and Foxglove for the low-rate topics of an estimator.

Those for the measurement coach are shipped in config/layouts. For another vehicle or namespace:

    python -m railtrack_ros.node.layouts --vehicle my_coach.yaml --node /coach7/track_estimator OUT
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

from railtrack_ros.errors import InputError
from railtrack_ros.estimation.indicators import BANDS, band_name
from railtrack_ros.vehicle.description import Vehicle, load_vehicle

NODE = '/track_estimator'
VEHICLE = 'measurement_coach'
FOXGLOVE, PLOTJUGGLER = 'foxglove.json', 'plotjuggler.xml'

COLOURS = ('#1f77b4', '#d62728', '#1ac938', '#ff7f0e', '#f14cc1', '#9467bd', '#17becf', '#bcbd22')

# Title and topics with the field that is drawn.
Plot = tuple[str, list[tuple[str, str]]]


def plots(vehicle: Vehicle, node: str = NODE) -> list[Plot]:
    """Return what is worth looking at: forces and the bands of corrugation by axle box, place."""
    boxes = [box.name for box in vehicle.axle_boxes]
    found: list[Plot] = [(
        'contact force, largest in 0.1 s [N]',
        [(f'{node}/wheel/{name}/contact_force', 'wrench.force.z') for name in boxes])]
    found += [(
        f'irregularity {band_name(band).replace("_", " to ")} mm, RMS of a section [um]',
        [(f'{node}/wheel/{name}/rms_{band_name(band)}', 'data') for name in boxes])
        for band in BANDS]
    found.append(('track position [m]', [(f'{node}/position', 'point.x')]))
    return found


# Foxglove


def foxglove(vehicle: Vehicle, node: str = NODE) -> str:
    """Return the layout of Foxglove as JSON: plots on the left, health on the right."""
    configuration: dict[str, Any] = {}
    for number, (title, lines) in enumerate(plots(vehicle, node)):
        stamped = not any(field == 'data' for _, field in lines)
        configuration[f'Plot!railtrack{number}'] = {
            'foxglovePanelTitle': title,
            'paths': [{
                'value': f'{topic}.{field}', 'enabled': True,
                'timestampMethod': 'headerStamp' if stamped else 'receiveTime',
                'label': _label(topic), 'color': colour,
            } for (topic, field), colour in zip(lines, _colours(lines), strict=True)],
            'showXAxisLabels': True, 'showYAxisLabels': True, 'showLegend': True,
            'legendDisplay': 'floating', 'showPlotValuesInLegend': True, 'isSynced': True,
            'xAxisVal': 'timestamp', 'sidebarDimension': 240, 'followingViewWidth': 60,
        }
    left = _stacked(list(configuration))
    health = 'DiagnosticSummary!railtrack'
    configuration[health] = {
        'minLevel': 0, 'pinnedIds': [], 'hardwareIdFilter': '', 'topicToRender': '/diagnostics',
        'sortByLevel': True}
    sections = 'RawMessages!railtrack'
    configuration[sections] = {
        'topicPath': f'{node}/corrugation', 'diffEnabled': False, 'diffMethod': 'custom',
        'diffTopicPath': '', 'showFullMessageForDiff': False}
    layout = {'first': left, 'second': _stacked([health, sections]), 'direction': 'row',
              'splitPercentage': 68}
    return json.dumps({
        'configById': configuration, 'globalVariables': {}, 'userNodes': {},
        'playbackConfig': {'speed': 1}, 'layout': layout}, indent=2) + '\n'


def _stacked(panels: Sequence[str]) -> Any:
    """Return panels one above the other, all of the same height."""
    if len(panels) == 1:
        return panels[0]
    return {'first': panels[0], 'second': _stacked(panels[1:]), 'direction': 'column',
            'splitPercentage': 100.0 / len(panels)}


# PlotJuggler


def plotjuggler(vehicle: Vehicle, node: str = NODE) -> str:
    """Return the layout of PlotJuggler as XML: forces and place in one tab, bands in another."""
    force, *bands, place = plots(vehicle, node)
    # Versions of the program that ask for it take this one; the others take any.
    root = Xml.Element('root', version='2.3.8')
    # In a dictionary, since `parent` is also an argument of the function.
    tabs = Xml.SubElement(root, 'tabbed_widget', {'parent': 'main_window', 'name': 'Main Window'})
    for name, drawn in (('forces', [force, place]), ('corrugation', bands)):
        tab = Xml.SubElement(tabs, 'Tab', containers='1', tab_name=name)
        share = ';'.join([f'{1.0 / len(drawn):.6f}'] * len(drawn))
        splitter = Xml.SubElement(Xml.SubElement(tab, 'Container'), 'DockSplitter',
                                  count=str(len(drawn)), orientation='-', sizes=share)
        for title, lines in drawn:
            area = Xml.SubElement(splitter, 'DockArea', name=title)
            plot = Xml.SubElement(area, 'plot', mode='TimeSeries', style='Lines', flip_x='false',
                                  flip_y='false')
            Xml.SubElement(plot, 'limitY')
            for (topic, field), colour in zip(lines, _colours(lines), strict=True):
                series = f'{topic}/{field.replace(".", "/")}'
                Xml.SubElement(plot, 'curve', name=series, color=colour)
    Xml.SubElement(tabs, 'currentTabIndex', index='0')
    Xml.SubElement(root, 'use_relative_time_offset', enabled='1')
    plugin = Xml.SubElement(Xml.SubElement(root, 'Plugins'), 'plugin', ID='ROS2 Topic Subscriber')
    for name, value in (('use_header_stamp', 'false'), ('discard_large_arrays', 'true'),
                        ('max_array_size', '100'), ('boolean_strings_to_number', 'true'),
                        ('remove_suffix_from_strings', 'true'),
                        ('selected_topics', ';'.join(
                            topic for _, lines in (force, *bands, place) for topic, _ in lines))):
        Xml.SubElement(plugin, name, value=value)
    Xml.SubElement(root, 'previouslyLoaded_Datafiles')
    Xml.SubElement(root, 'previouslyLoaded_Streamer', name='ROS2 Topic Subscriber')
    Xml.SubElement(root, 'customMathEquations')
    Xml.SubElement(root, 'snippets')
    Xml.indent(root, ' ')
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + Xml.tostring(root, 'unicode') + '\n'


def _label(topic: str) -> str:
    parts = topic.split('/')
    return parts[-2] if 'wheel' in parts else parts[-1]


def _colours(lines: Iterable[Any]) -> list[str]:
    return [COLOURS[number % len(COLOURS)] for number, _ in enumerate(lines)]


def main() -> int:
    """Write both layouts to a folder."""
    parser = argparse.ArgumentParser(prog='python -m railtrack_ros.node.layouts')
    parser.add_argument('--vehicle', default=VEHICLE, help='shipped vehicle or YAML file')
    parser.add_argument('--node', default=NODE, help='full name of the estimator')
    parser.add_argument('output', type=Path, help='folder')
    args = parser.parse_args()
    try:
        vehicle = load_vehicle(args.vehicle)
    except InputError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / FOXGLOVE).write_text(foxglove(vehicle, args.node), encoding='utf-8')
    (args.output / PLOTJUGGLER).write_text(plotjuggler(vehicle, args.node), encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
