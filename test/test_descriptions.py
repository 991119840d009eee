"""Tracks and vehicles: what the shipped files say, and what a file may not say."""

import dataclasses
import math

import pytest
import yaml

from railtrack_ros import paths
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import make_bay
from railtrack_ros.track.description import (
    SUPPORT_KINDS,
    BallastLiftOff,
    PadNonlinearity,
    load_track,
    shipped_tracks,
)
from railtrack_ros.vehicle.description import load_vehicle, shipped_vehicles

TRACK = """
rail: {youngs_modulus: 210.0e9, poisson_ratio: 0.3, area: 7.69e-3, second_moment: 3.055e-5,
       density: 7850.0, shear_coefficient: 0.4, loss_factor: 0.02}
support: {kind: distributed, spacing: 0.6, pad_length: 0.16, pad_stiffness: 350.0e6,
          pad_damping: 48.0e3, sleeper_mass: 160.0, ballast_stiffness: 70.0e6,
          ballast_damping: 47.0e3}
"""
VEHICLE = """
wheel: {mass: 550.0, static_load: 100.0e3, radius: 0.46}
contact: {stiffness: 100.0e9, exponent: 1.5}
axle_boxes:
  - {name: lead, rail: left, offset: 0.0}
  - {name: trail, rail: left, offset: -2.5}
"""


def changed(text, place, value):
    """Return YAML text in which the value at a place (keys and list indices) is another."""
    content = yaml.safe_load(text)
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return yaml.safe_dump(content)


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / 'case.yaml'
        path.write_text(text)
        return path

    return write


def test_the_contracted_tracks_and_vehicles_are_shipped():
    assert {'blanco_table_2_1', 'blanco_table_3_1', 'mainline_soft_pads'} <= set(shipped_tracks())
    assert {'blanco_table_2_1', 'blanco_table_3_1', 'measurement_coach'} <= set(shipped_vehicles())
    for name in shipped_tracks():
        assert load_track(name).name == name
        assert load_track(name).description
    for name in shipped_vehicles():
        assert load_vehicle(name).name == name
        assert load_vehicle(name).description


def test_table_3_1_is_as_published_with_its_misprint_corrected(table_3_1, write):
    assert dataclasses.replace(table_3_1, name='case', description='') == load_track(write(TRACK))


def test_the_density_of_table_2_1_is_its_mass_of_56_kg_per_metre(table_2_1):
    assert table_2_1.rail.mass_per_length == pytest.approx(56.0, rel=1e-5)


def test_the_rail_of_the_main_line_is_a_60_kg_rail():
    assert load_track('mainline_soft_pads').rail.mass_per_length == pytest.approx(60.21, rel=1e-3)


def test_the_pinned_pinned_wave_of_table_3_1_lies_near_1_1_khz(table_3_1):
    """A Timoshenko beam of half wavelength l: 1068 Hz in the infinite track of table 3.1."""
    rail, wavenumber = table_3_1.rail, math.pi / table_3_1.support.spacing
    bending = rail.bending_stiffness * wavenumber**2
    # det [[kAG k2 - mw2, kAG k], [kAG k, kAG + EI k2 - rho I w2]] = 0
    shear, mass, inertia = rail.shear_stiffness, rail.mass_per_length, rail.rotary_inertia
    a = mass * inertia
    b = -(mass * (shear + bending) + inertia * shear * wavenumber**2)
    c = shear * wavenumber**2 * bending
    frequency = math.sqrt((-b - math.sqrt(b * b - 4 * a * c)) / (2 * a)) / (2 * math.pi)
    assert frequency == pytest.approx(1068.16, rel=1e-5)


def test_the_measurement_coach_has_four_axles_on_two_rails():
    coach = load_vehicle('measurement_coach')
    assert coach.rails == ('left', 'right')
    for rail in coach.rails:
        boxes = coach.on_rail(rail)
        assert [box.name for box in boxes] == [f'axle{n}_{rail}' for n in (1, 2, 3, 4)]
        assert [box.offset for box in boxes] == [0.0, -2.5, -19.0, -21.5]


def test_a_vehicle_on_one_rail_has_no_boxes_on_the_other(write):
    vehicle = load_vehicle(write(VEHICLE))
    assert vehicle.rails == ('left',)
    assert vehicle.on_rail('right') == ()
    assert vehicle.contact.damping == 0.0


def test_stretches_and_single_sleepers_change_their_own_bays_only(write):
    path = write(yaml.safe_dump({
        **yaml.safe_load(TRACK),
        'stretches': [
            {'from': 6.0, 'to': 12.0, 'support': {'ballast_stiffness': 20e6}},
            {'from': 12.0, 'to': 18.0, 'rail': {'area': 8e-3}, 'support': {'kind': 'multipoint'}},
        ],
        'sleepers': [{'index': 12, 'ballast_damping': 0}, {'index': -3, 'ballast_stiffness': 0}],
    }))
    track = load_track(path)
    assert not track.periodic
    ballast = [track.bay(k).support.ballast_stiffness for k in (-3, 0, 9, 10, 12, 19, 20, 30)]
    assert ballast == [0, 70e6, 70e6, 20e6, 20e6, 20e6, 70e6, 70e6]
    assert [track.bay(k).support.ballast_damping for k in (11, 12, 13)] == [47e3, 0, 47e3]
    assert [track.bay(k).rail.area for k in (19, 20, 29, 30)] == [7.69e-3, 8e-3, 8e-3, 7.69e-3]
    assert [track.bay(k).support.kind for k in (19, 25)] == ['distributed', 'multipoint']
    assert all(track.bay(k).periodic for k in (-3, 12))
    with pytest.raises(InputError, match='stretches: a ring needs a periodic track'):
        track.require_periodic('a ring')


def test_non_linear_supports_are_read_inherited_and_refused_by_linear_models(write):
    changes = {'support': {**yaml.safe_load(TRACK)['support'], 'pad_nonlinearity': {
        'preload': 2e4, 'unloaded_stiffness': 1e8}}, 'sleepers': [
            {'index': 4, 'ballast_lift_off': {'gap': 1e-3}}, {'index': 5, 'pad_stiffness': 0}]}
    track = load_track(write(yaml.safe_dump({**yaml.safe_load(TRACK), **changes})))
    assert track.support.pad_nonlinearity == PadNonlinearity(2e4, 1e8)
    assert track.bay(4).support.pad_nonlinearity == PadNonlinearity(2e4, 1e8)
    assert track.bay(4).support.ballast_lift_off == BallastLiftOff(gap=1e-3)
    assert track.bay(5).support.linear
    with pytest.raises(InputError, match='support.pad_nonlinearity: a ring cannot take it'):
        track.require_linear('a ring')
    with pytest.raises(InputError, match='pad_nonlinearity: a linear model cannot take it'):
        make_bay(track.bay(0))


@pytest.mark.parametrize('kind', SUPPORT_KINDS)
def test_every_contracted_kind_of_support_is_read(write, kind):
    path = write(changed(TRACK, ['support', 'kind'], kind))
    assert load_track(path).support.kind == kind


@pytest.mark.parametrize(
    ('place', 'value', 'message'),
    [
        (['rail', 'youngs_modulus'], 0, 'rail.youngs_modulus: expected a number above 0, got 0'),
        (['rail', 'area'], -1, 'rail.area: expected a number above 0, got -1'),
        (['rail', 'area'], math.nan, 'rail.area: expected a number above 0, got nan'),
        (['rail', 'density'], math.inf, 'rail.density: expected a number above 0, got inf'),
        (['rail', 'second_moment'], True, 'rail.second_moment: expected a number above 0'),
        (['rail', 'poisson_ratio'], 0.6, 'rail.poisson_ratio: expected a number above -1 and'),
        (['rail', 'poisson_ratio'], -1, 'rail.poisson_ratio: expected a number above -1 and'),
        (['rail', 'shear_coefficient'], 1.2, 'rail.shear_coefficient: expected'),
        (['rail', 'loss_factor'], -0.02, 'rail.loss_factor: expected a number of at least 0'),
        (['rail', 'colour'], 'red', 'rail.colour: unknown key'),
        (['rail'], None, 'rail: expected keys with values, got nothing'),
        (['rail'], [1], 'rail: expected keys with values, got a list'),
        (['rali'], {}, "rali: unknown key; did you mean 'rail'?"),
        (['support', 'kind'], 'slab', "support.kind: unknown value 'slab'; expected one of con"),
        (['support', 'kind'], 'Distributed', "did you mean 'distributed'?"),
        (['support', 'spacing'], '0.6 m', 'support.spacing: expected a number above 0, got the'),
        (['support', 'pad_length'], 0.7, 'less than the sleeper spacing of 0.6 m, got 0.7'),
        (['support', 'pad_length'], 0.6, 'less than the sleeper spacing of 0.6 m, got 0.6'),
        (['support', 'pad_length'], 0, 'support.pad_length: expected a number above 0'),
        (['support', 'pad_stiffness'], -350e6, 'support.pad_stiffness: expected a number above 0'),
        (['support', 'pad_damping'], -1, 'support.pad_damping: expected a number of at least 0'),
        (['support', 'sleeper_mass'], 0, 'support.sleeper_mass: expected a number above 0'),
        (['support', 'ballast_stiffness'], 0, 'support.ballast_stiffness: expected a number'),
        (['support', 'pad_nonlinearity'], {}, 'support.pad_nonlinearity.preload: missing key'),
        (['support', 'pad_nonlinearity'], {'preload': 2e4, 'unloaded_stiffness': 351e6},
         'unloaded_stiffness: expected a number above 0 and of at most 3.5e+08, got 3.51e+08'),
        (['support', 'ballast_lift_off'], {'preload': 3e3, 'gap': 1e-3},
         'support.ballast_lift_off: expected preload'),
        (['support', 'ballast_lift_off'], {'gap': -1e-3}, 'ballast_lift_off.gap: expected a numb'),
        (['sleepers'], [{'index': 1, 'ballast_lift_off': {}}],
         'sleepers[0].ballast_lift_off: expected preload'),
        (['stretches'], [], 'stretches: expected a list of at least one entry, got an empty list'),
        (['stretches'], [{'from': 3, 'to': 2}], 'stretches[0].to: expected more than from'),
        (['stretches'], [{'from': 0, 'to': 2}], 'stretches[0]: changes nothing'),
        (['stretches'], [{'from': 0, 'to': 2, 'support': {'spacing': 0.7}}],
         'stretches[0].support.spacing: the sleeper spacing is the same along the whole track'),
        (['stretches'], [{'from': 0, 'to': 2, 'rail': {'areaa': 0.7}}],
         "stretches[0].rail.areaa: unknown key; did you mean 'area'?"),
        (['stretches'], [{'from': 0, 'to': 2, 'rail': {'area': 7e-3}},
                         {'from': 1, 'to': 3, 'rail': {'area': 8e-3}}],
         'stretches[1].from: overlaps the stretch from 0 to 2 m'),
        (['sleepers'], [], 'sleepers: expected a list of at least one entry, got an empty list'),
        (['sleepers'], [{'index': 0.5}], 'sleepers[0].index: expected a whole number'),
        (['sleepers'], [{'index': 1, 'pad_stiffness': -1}], 'sleepers[0].pad_stiffness: expected'),
        (['sleepers'], [{'index': 1, 'pad_stiffness': 0, 'ballast_stiffness': 0}],
         'sleepers[0].pad_stiffness: a sleeper needs a pad or ballast'),
        (['sleepers'], [{'index': 1, 'pad_stiffness': 1}, {'index': 1, 'pad_stiffness': 2}],
         'sleepers[1].index: sleeper 1 is given twice'),
        (['description'], 12, 'description: expected text, got 12'),
    ],
)
def test_a_track_that_cannot_be_is_refused(write, place, value, message):
    path = write(changed(TRACK, place, value))
    with pytest.raises(InputError) as refusal:
        load_track(path)
    assert str(refusal.value).startswith(f'{path}: ')
    assert message in str(refusal.value)


@pytest.mark.parametrize(
    ('place', 'value', 'message'),
    [
        (['wheel', 'mass'], 0, 'wheel.mass: expected a number above 0'),
        (['wheel', 'static_load'], -1, 'wheel.static_load: expected a number above 0'),
        (['wheel', 'radius'], math.nan, 'wheel.radius: expected a number above 0, got nan'),
        (['wheel', 'suspension'], {}, 'wheel.suspension.stiffness: missing key'),
        (['wheel', 'suspension'], {'stiffness': 1e6, 'damping': 1e4, 'sprung_mass': 0},
         'wheel.suspension.sprung_mass: expected a number above 0'),
        (['wheel', 'modes'], [], 'wheel.modes: expected a list of at least one entry'),
        (['wheel', 'modes'], [{'frequency': 80, 'damping_ratio': 1.5, 'contact_shape': 0.04,
                               'axle_box_shape': 0.03}],
         'wheel.modes[0].damping_ratio: expected a number of at least 0 and below 1'),
        (['contact', 'stiffness'], 0, 'contact.stiffness: expected a number above 0'),
        (['contact', 'exponent'], 0.5, 'contact.exponent: expected a number of at least 1'),
        (['contact', 'damping'], 'much', 'contact.damping: expected a number of at least 0'),
        (['contact', 'damping'], -1, 'contact.damping: expected a number of at least 0'),
        (['axle_boxes'], [], 'axle_boxes: expected a list of at least one entry, got an empty'),
        (['axle_boxes', 1, 'name'], 'lead', "axle_boxes[1].name: 'lead' is the name of an axle"),
        (['axle_boxes', 1, 'name'], '2nd', "axle_boxes[1].name: '2nd' cannot name a channel"),
        (['axle_boxes', 1, 'name'], 'a b', "axle_boxes[1].name: 'a b' cannot name a channel"),
        (['axle_boxes', 1, 'name'], 'a\n', 'axle_boxes[1].name: '),
        (['axle_boxes', 1, 'name'], 'ä', "axle_boxes[1].name: 'ä' cannot name a channel"),
        (['axle_boxes', 1, 'name'], '', "axle_boxes[1].name: '' cannot name a channel"),
        (['axle_boxes', 1, 'name'], 't', "axle_boxes[1].name: 't' cannot name a channel"),
        (['axle_boxes', 1, 'name'], 64 * 'x' + 'x', 'axle_boxes[1].name: '),
        (['axle_boxes', 1, 'name'], 1, 'axle_boxes[1].name: expected text, got 1'),
        (['axle_boxes', 0, 'rail'], 'center', "axle_boxes[0].rail: unknown value 'center'"),
        (['axle_boxes', 0, 'offset'], math.inf, 'axle_boxes[0].offset: expected a number'),
        (['axle_boxes', 1, 'offset'], 0, "axle_boxes[1].offset: 'trail' is where 'lead' is"),
        (['axle_boxes', 1, 'wheel'], 1, 'axle_boxes[1].wheel: unknown key'),
    ],
)
def test_a_vehicle_that_cannot_be_is_refused(write, place, value, message):
    path = write(changed(VEHICLE, place, value))
    with pytest.raises(InputError) as refusal:
        load_vehicle(path)
    assert str(refusal.value).startswith(f'{path}: ')
    assert message in str(refusal.value)
    assert '\n' not in str(refusal.value)


@pytest.mark.parametrize('section', ['rail', 'support'])
def test_every_key_of_a_track_is_required(write, section):
    for key in yaml.safe_load(TRACK)[section]:
        content = yaml.safe_load(TRACK)
        del content[section][key]
        with pytest.raises(InputError, match=f'{section}.{key}: missing key'):
            load_track(write(yaml.safe_dump(content)))


def test_a_contact_damping_of_zero_is_no_damping(write):
    path = write(changed(VEHICLE, ['contact', 'damping'], 0))
    assert load_vehicle(path).contact.damping == 0.0


def test_an_unknown_name_lists_the_shipped_ones_and_the_closest():
    with pytest.raises(InputError) as refusal:
        load_track('blanco_table_31')
    assert "unknown track 'blanco_table_31'; did you mean 'blanco_table_3_1'?" in str(refusal.value)
    assert 'mainline_soft_pads' in str(refusal.value)
    with pytest.raises(InputError, match="unknown vehicle ''"):
        load_vehicle('')


def test_a_path_that_is_not_there_is_told_as_a_file(tmp_path):
    with pytest.raises(InputError, match='none.yaml: no such track file'):
        load_track(tmp_path / 'none.yaml')


def test_a_file_is_found_by_any_kind_of_path(write, tmp_path, monkeypatch):
    write(TRACK)
    (tmp_path / 'bare').write_text(TRACK)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('HOME', str(tmp_path))
    for name in ('case.yaml', './case.yaml', '~/case.yaml', 'bare', tmp_path / 'case.yaml'):
        assert load_track(name).support.spacing == 0.6


def test_configuration_is_found_in_an_installation(tmp_path):
    share = tmp_path / 'share' / 'railtrack_ros'
    (share / 'config' / 'tracks').mkdir(parents=True)
    for packages in ('lib/python3.11/site-packages', 'local/lib/python3.12/dist-packages'):
        module = tmp_path / packages / 'railtrack_ros' / 'paths.py'
        assert paths.share_directory(module) == share


def test_an_installation_without_configuration_is_told(tmp_path):
    with pytest.raises(InputError, match='without its config folder'):
        paths.share_directory(tmp_path / 'railtrack_ros' / 'paths.py')


def test_reference_data_is_where_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setenv('RAILTRACK_DATA', str(tmp_path))
    assert paths.reference_data() == tmp_path
    monkeypatch.setenv('RAILTRACK_DATA', str(tmp_path / 'none'))
    assert paths.reference_data() is None
