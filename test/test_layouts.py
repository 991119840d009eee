"""The layouts of PlotJuggler and Foxglove that are shipped draw topics and fields that exist."""

import json
from xml.etree import ElementTree as Xml

import pytest

from railtrack_ros.bags.codec import POINT
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.node import layouts
from railtrack_ros.paths import config_directory
from railtrack_ros.runs.results import ResultMessages
from railtrack_ros.vehicle.description import load_vehicle

FOLDER = config_directory() / 'layouts'
COACH = load_vehicle('measurement_coach')


@pytest.mark.parametrize(('name', 'make'), [
    (layouts.FOXGLOVE, layouts.foxglove), (layouts.PLOTJUGGLER, layouts.plotjuggler)])
def test_the_shipped_layouts_are_those_of_the_measurement_coach(name, make):
    assert (FOLDER / name).read_text(encoding='utf-8') == make(COACH)


def test_every_line_is_a_number_of_a_topic_that_the_node_publishes():
    topics = {f'{layouts.NODE}/{topic}': kind
              for topic, kind in ResultMessages.topics(COACH).items()}
    topics[f'{layouts.NODE}/position'] = POINT
    drawn = [line for _, lines in layouts.plots(COACH) for line in lines]
    assert len(drawn) == 5 * 8 + 1
    for topic, fields in drawn:
        value = LIVE.get(topics[topic])()
        for field in fields.split('.'):
            value = getattr(value, field)
        assert isinstance(value, float)


def panels(layout):
    if isinstance(layout, str):
        return [layout]
    assert set(layout) == {'first', 'second', 'direction', 'splitPercentage'}
    assert layout['direction'] in ('row', 'column')
    return panels(layout['first']) + panels(layout['second'])


def test_foxglove_places_every_panel_once():
    content = json.loads(layouts.foxglove(COACH, '/coach7/track_estimator'))
    assert sorted(panels(content['layout'])) == sorted(content['configById'])
    kinds = {name.split('!')[0] for name in content['configById']}
    assert kinds == {'Plot', 'DiagnosticSummary', 'RawMessages'}
    for name, panel in content['configById'].items():
        if name.startswith('Plot!'):
            assert all(path['value'].startswith('/coach7/') for path in panel['paths'])
            assert len({path['label'] for path in panel['paths']}) == len(panel['paths'])


def test_plotjuggler_subscribes_to_every_topic_that_it_draws():
    root = Xml.fromstring(layouts.plotjuggler(COACH))
    [selected] = root.iter('selected_topics')
    subscribed = selected.get('value').split(';')
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert len(curves) == 41
    for curve in curves:
        assert any(curve.startswith(f'{topic}/') for topic in subscribed)
    for splitter in root.iter('DockSplitter'):
        assert len(splitter) == int(splitter.get('count')) == len(splitter.get('sizes').split(';'))
