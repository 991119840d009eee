"""Named resonances against exact numbers computed independently."""

import pytest
from frequency_domain import variant

from railtrack_ros.dynamics.resonances import (
    contact_stiffness,
    p2_resonances,
    track_resonances,
)
from railtrack_ros.track.description import load_track
from railtrack_ros.track.rail import pinned_pinned_frequency
from railtrack_ros.vehicle.description import load_vehicle

# frequency [Hz], |H| [m/N]
CASES = [
    ('blanco_table_3_1', 0.0, 'concentrated', 'midspan',
     {'in-phase': (89.51, 1.4259e-8), 'dip': (232.5, 1.2295e-9),
      'out-of-phase': (511.7, 3.5670e-9), 'pinned-pinned': (1068.16, None)}),
    ('blanco_table_3_1', 0.0, 'concentrated', 'sleeper',
     {'in-phase': (89.95, 1.4036e-8), 'dip': (271.9, 1.0326e-9),
      'out-of-phase': (514.4, 2.4821e-9), 'pinned-pinned antiresonance': (1111.95, 1.1868e-10)}),
    ('blanco_table_3_1', 0.0, 'distributed', 'midspan',
     {'in-phase': (89.66, 1.3992e-8), 'dip': (236.0, 1.2012e-9),
      'out-of-phase': (517.3, 3.3435e-9), 'pinned-pinned': (1080.69, 3.3240e-9)}),
    ('blanco_table_3_1', 0.0, 'distributed', 'sleeper',
     {'in-phase': (90.00, 1.3845e-8), 'dip': (270.2, 1.0612e-9),
      'out-of-phase': (519.4, 2.4967e-9), 'pinned-pinned antiresonance': (1123.5, 1.6648e-10)}),
    ('blanco_table_3_1', 0.02, 'concentrated', 'midspan',
     {'in-phase': (89.52, 1.4265e-8), 'dip': (232.6, 1.2428e-9),
      'out-of-phase': (511.4, 3.5672e-9), 'pinned-pinned': (1068.43, 3.5594e-9)}),
    ('blanco_table_3_1', 0.02, 'distributed', 'midspan',
     {'in-phase': (89.67, 1.3998e-8), 'dip': (236.1, 1.2129e-9),
      'out-of-phase': (517.2, 3.3469e-9), 'pinned-pinned': (1080.30, 2.4672e-9)}),
    ('blanco_table_3_1', 0.0, 'concentrated_rotational', 'midspan',
     {'pinned-pinned': (1072.91, 5.435e-9)}),
    ('blanco_table_2_1', 0.0, 'concentrated', 'midspan',
     {'in-phase': (86.74, 3.5858e-8), 'dip': (287.9, 2.1267e-9),
      'out-of-phase': (455.3, 5.3488e-9), 'pinned-pinned': (619.49, None)}),
    ('blanco_table_2_1', 0.0, 'distributed', 'midspan',
     {'in-phase': (86.88, 3.5236e-8), 'dip': (291.1, 2.0784e-9),
      'out-of-phase': (461.3, 5.1296e-9), 'pinned-pinned': (625.42, 1.5424e-8)}),
    ('blanco_table_2_1', 0.02, 'concentrated', 'midspan',
     {'in-phase': (86.74, 3.5866e-8), 'dip': (287.8, 2.1620e-9),
      'out-of-phase': (455.4, 5.3613e-9), 'pinned-pinned': (619.62, 1.0306e-8)}),
    ('blanco_table_2_1', 0.02, 'distributed', 'midspan',
     {'in-phase': (86.88, 3.5247e-8), 'dip': (291.0, 2.1117e-9),
      'out-of-phase': (461.4, 5.1470e-9), 'pinned-pinned': (625.40, 8.6615e-9)}),
]


@pytest.mark.parametrize(('name', 'loss_factor', 'kind', 'place', 'expected'), CASES)
def test_resonances_of_the_thesis_tracks(name, loss_factor, kind, place, expected):
    track = variant(load_track(name), loss_factor, kind=kind)
    found = {r.name: r for r in track_resonances(track) if r.place == place}
    for resonance, (frequency, magnitude) in expected.items():
        # Both are rounded to the digits given; a frequency of a flat extremum less sure.
        assert found[resonance].frequency == pytest.approx(frequency, abs=0.06)
        if magnitude is None:  # infinite without loss
            assert found[resonance].magnitude > 1e-7
        else:
            assert found[resonance].magnitude == pytest.approx(magnitude, rel=1e-4)


@pytest.mark.parametrize(('loss_factor', 'magnitude'), [
    (1e-4, 4.70e-8), (1e-3, 1.50e-8), (5e-3, 6.85e-9), (0.01, 4.92e-9), (0.02, 3.56e-9)])
def test_pinned_pinned_peak_falls_with_the_root_of_the_loss_factor(
        loss_factor, magnitude, table_3_1):
    track = variant(table_3_1, loss_factor, kind='concentrated')
    peak = next(r for r in track_resonances(track) if r.name == 'pinned-pinned')
    assert peak.magnitude == pytest.approx(magnitude, rel=2e-3)


def test_soft_pads_part_rail_and_sleeper_earlier():
    track = load_track('mainline_soft_pads')
    found = {r.name: r.frequency for r in track_resonances(track) if r.place == 'midspan'}
    assert list(found) == ['in-phase', 'dip', 'out-of-phase', 'pinned-pinned']
    assert sorted(found.values()) == list(found.values())
    pinned = pinned_pinned_frequency(track.rail, track.support.spacing)
    assert found['pinned-pinned'] == pytest.approx(pinned, rel=0.01)


def test_a_track_without_the_dip_is_told_so(table_3_1):
    # So much damping in the pads that rail and sleeper never part.
    track = variant(table_3_1, kind='concentrated', pad_damping=2e6)
    names = [r.name for r in track_resonances(track) if r.place == 'midspan']
    assert 'in-phase' in names
    assert 'out-of-phase' not in names


@pytest.mark.parametrize(('name', 'midspan', 'sleeper'), [
    ('blanco_table_3_1', (62.3, 326e6), (63.0, 312e6)),
    ('blanco_table_2_1', (47.0, 260e6), (47.8, 249e6)),
])
def test_p2_of_the_thesis_vehicles(name, midspan, sleeper):
    track = variant(load_track(name), 0.0, kind='concentrated')
    found = {r.place: r for r in p2_resonances(track, load_vehicle(name))}
    for place, (frequency, force) in (('midspan', midspan), ('sleeper', sleeper)):
        assert found[place].frequency == pytest.approx(frequency, abs=0.1)
        assert found[place].magnitude == pytest.approx(force, rel=3e-3)


def test_contact_is_linearised_at_the_static_load():
    vehicle = load_vehicle('blanco_table_3_1')
    k, n, load = vehicle.contact.stiffness, vehicle.contact.exponent, vehicle.wheel.static_load
    indentation = (load / k) ** (1.0 / n)
    slope = k * ((indentation * 1.0001) ** n - (indentation * 0.9999) ** n) / (
        0.0002 * indentation)
    assert contact_stiffness(vehicle) == pytest.approx(slope, rel=1e-6)
