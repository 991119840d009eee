"""The full model on any track under any wheel: against brute force, and by its physics."""

import dataclasses

import numpy as np
import pytest
from brute_force import BruteForce

from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.irregularity import profile
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import (
    BallastLiftOff,
    PadNonlinearity,
    Stretch,
    load_track,
)
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import Suspension, WheelMode, load_vehicle

TRACK = load_track('blanco_table_3_1')
WHEEL = load_vehicle('blanco_table_3_1')
LOAD = WHEEL.wheel.static_load
PAD = PadNonlinearity(preload=20e3, unloaded_stiffness=120e6)
SUSPENSION = Suspension(stiffness=1.2e6, damping=2e4, sprung_mass=5000.0)
MODES = (WheelMode(85.0, 0.01, 0.03, -0.035), WheelMode(1900.0, 0.005, 0.06, 0.01))


def with_support(track=TRACK, **changes):
    return dataclasses.replace(track, support=dataclasses.replace(track.support, **changes))


def with_wheel(suspension=None, modes=(), damping=0.0):
    return dataclasses.replace(
        WHEEL, wheel=dataclasses.replace(WHEEL.wheel, suspension=suspension, modes=modes),
        contact=dataclasses.replace(WHEEL.contact, damping=damping))


SOFT = dataclasses.replace(TRACK.support, pad_stiffness=80e6, pad_damping=30e3)
POINT = dataclasses.replace(TRACK.support, kind='concentrated', ballast_stiffness=40e6)
HANGING = dataclasses.replace(TRACK.support, ballast_lift_off=BallastLiftOff(gap=0.3e-3))
OTHER_RAIL = dataclasses.replace(TRACK.rail, loss_factor=0.1, second_moment=2.4e-5)
UNEVEN = dataclasses.replace(
    TRACK, stretches=(Stretch(1.0, 4.0, OTHER_RAIL, SOFT), Stretch(4.0, 7.0, TRACK.rail, POINT)),
    sleepers=((0, SOFT), (3, dataclasses.replace(TRACK.support, ballast_stiffness=0.0,
                                                 ballast_damping=0.0))))
ODD = dataclasses.replace(UNEVEN, sleepers=((0, HANGING), (1, dataclasses.replace(
    SOFT, pad_nonlinearity=PadNonlinearity(preload=15e3, unloaded_stiffness=30e6)))))


def rough(position, offsets, factor=3.0):
    made = profile.iso3095(60.0, 1e-3, seed=5, start=-30.0)
    return factor * made.at(position[:, None] + np.array(offsets))


def run_both(track, mesh, vehicle, start=0.1, step=50e-6, steps=60, **options):
    row, offsets = BayRow(track, mesh), (0.0, -1.5)
    position = start + 40.0 * step * np.arange(steps + 1)
    irregularity = rough(position, offsets)
    model = FullModel(row, vehicle, offsets, step, start, margin=11, **options)
    twin = BruteForce(row, vehicle, offsets, step, model.first_bay, model.bays)
    found = model.run(position, irregularity)
    return found, twin.run(position, irregularity), model


def check(found, expected, limit=1e-8):
    for one, other in zip(found.arrays(), expected, strict=True):
        assert np.abs(one - other).max() <= limit * np.abs(other).max()


@pytest.mark.parametrize(('track', 'mesh', 'vehicle'), [
    (UNEVEN, Mesh(4), WHEEL),
    (UNEVEN, Mesh(4, local_system='none'), WHEEL),
    (UNEVEN, Mesh(4, local_system='dynamic', modes_per_element=2), WHEEL),
    (TRACK, Mesh(4), with_wheel(SUSPENSION)),
    (TRACK, Mesh(4), with_wheel(modes=MODES, damping=3e4)),
    (TRACK, Mesh(4), with_wheel(SUSPENSION, MODES)),
    (with_support(pad_nonlinearity=PAD), Mesh(4), WHEEL),
    (with_support(pad_nonlinearity=PAD, kind='concentrated'), Mesh(4), WHEEL),
    (with_support(pad_nonlinearity=PAD, kind='multipoint'), Mesh(6), WHEEL),
    (with_support(ballast_lift_off=BallastLiftOff(preload=100.0)), Mesh(4), WHEEL),
    (ODD, Mesh(4), with_wheel(SUSPENSION, MODES, 1e4)),
], ids=['uneven', 'uneven, no local system', 'uneven, local modes', 'suspension',
        'modes, damping', 'suspension and modes', 'distributed pad', 'point pad',
        'multipoint pad', 'lift-off', 'everything'])
def test_agrees_with_brute_force(track, mesh, vehicle):
    # The uneven track is run where the window moves on to the next bay.
    found, expected, model = run_both(track, mesh, vehicle, 0.21 if track is UNEVEN else 0.1)
    assert model.first_bay == (-13 if track is UNEVEN else -14)
    assert np.ptp(expected[0]) > 3e3
    check(found, expected)


def test_bays_that_share_their_rail_are_the_bays_of_their_own_support():
    heavy = dataclasses.replace(HANGING, sleeper_mass=300.0, ballast_stiffness=3e7,
                                ballast_damping=1e4)
    track = dataclasses.replace(UNEVEN, sleepers=((-2, heavy), (3, HANGING), (9, SOFT)))
    row = BayRow(track, Mesh(4))
    for number, kind in zip(range(-5, 15), row.kind(-5, 20), strict=True):
        alone, found = make_bay(track.bay(number), Mesh(4), tangent=True), row.kinds[kind]
        assert (found.track.rail, found.track.support) == (alone.track.rail, alone.track.support)
        for name in ('stiffness', 'damping', 'mass', 'rail_stiffness'):
            expected = getattr(alone, name)
            assert np.abs(getattr(found, name) - expected).max() <= 1e-15 * np.abs(expected).max()
    assert len(row.kinds) == 6
