"""Contact force from the axle box's acceleration, against full models with such wheels."""

import dataclasses

import numpy as np
import pytest
from scipy import signal

from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.wheel import WheelInverse
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import Suspension, WheelMode, load_vehicle

RATE = 25600.0
VEHICLE = load_vehicle('blanco_table_3_1')
SUSPENSION = Suspension(stiffness=1.2e6, damping=2e4, sprung_mass=8000.0)
MODES = (WheelMode(330.0, 0.01, 0.02, 0.025), WheelMode(85.0, 0.01, 0.015, -0.02))


def vehicle(suspension=None, modes=(), damping=0.0):
    return dataclasses.replace(
        VEHICLE, wheel=dataclasses.replace(VEHICLE.wheel, suspension=suspension, modes=modes),
        contact=dataclasses.replace(VEHICLE.contact, damping=damping))


def driven(wheels):
    """A full model on ISO 3095 roughness at half the sample period; every second step of it."""
    x = 25.0 * np.arange(round(0.9 * 2 * RATE)) / (2 * RATE)
    r = iso3095(40.0, seed=3, start=-5.0).at(x[:, None])
    ran = FullModel(make_bay(load_track('blanco_table_3_1'), Mesh(6)), wheels, [0.0], 0.5 / RATE,
                    0.0, margin=20).run(x, r)
    indentation = ran.rail_deflection + r - ran.wheel_displacement
    return ran.axle_box_acceleration[::2], ran.contact_force[::2], indentation[::2]


@pytest.mark.parametrize(('wheels', 'limit'), [
    (vehicle(SUSPENSION), 5e-4), (vehicle(modes=MODES[:1]), 3e-3),
    (vehicle(SUSPENSION, MODES), 4e-3)])
def test_force_of_a_sprung_or_flexible_wheel_comes_back(wheels, limit):
    a, force, indentation = driven(wheels)
    found, pressed, alive = WheelInverse(wheels, 1.0 / RATE, 1)(a.copy())
    assert alive.all()
    settled = slice(6000, None)
    assert np.std(found[settled] - force[settled]) < limit * np.std(force[settled])
    assert np.std(pressed[settled] - indentation[settled]) < limit * np.std(indentation[settled])
    # A rigid wheel would not do.
    rigid = 100e3 + 550.0 * a
    assert np.std(rigid[settled] - force[settled]) > 10.0 * limit * np.std(force[settled])


def test_indentation_of_a_damped_contact_comes_back_below_2500_hz():
    wheels = vehicle(damping=5e4)
    a, _, indentation = driven(wheels)
    _, found, _ = WheelInverse(wheels, 1.0 / RATE, 1)(a.copy())
    _, undamped, _ = WheelInverse(VEHICLE, 1.0 / RATE, 1)(a.copy())
    band = signal.butter(3, (30.0, 2500.0), 'bandpass', fs=RATE, output='sos')
    truth, back, without = (signal.sosfiltfilt(band, x[:, 0])[6000:-200]
                            for x in (indentation, found, undamped))
    assert np.std(back - truth) < 0.02 * np.std(truth)
    assert np.std(without - truth) > 0.1 * np.std(truth)


def test_a_constant_error_of_the_sensor_stays_constant():
    """No filter integrates it: the suspension's free lift has cancelled."""
    wheels = vehicle(SUSPENSION, MODES)
    force, _, _ = WheelInverse(wheels, 1.0 / RATE, 1)(np.full((400_000, 1), 0.5))
    assert abs(force[-1, 0] - force[300_000, 0]) < 1.0
    assert force[-1, 0] == pytest.approx(100e3 + 0.5 * (550.0 + 8000.0), abs=1.0)


def test_blocks_and_saved_state_change_nothing():
    wheels = vehicle(SUSPENSION, MODES, damping=2e4)
    a = 20.0 * np.random.default_rng(1).standard_normal((4000, 2))
    whole = WheelInverse(wheels, 1.0 / RATE, 2)(a.copy())
    first, second = (WheelInverse(wheels, 1.0 / RATE, 2) for _ in range(2))
    parts = [first(a[:1000].copy()), first(a[1000:1001].copy())]
    second.restore(first.state())
    parts.append(second(a[1001:].copy()))
    for i, expected in enumerate(whole):
        assert np.array_equal(np.concatenate([part[i] for part in parts]), expected)


def test_a_box_that_a_sudden_force_does_not_lift_is_refused():
    with pytest.raises(InputError, match='does not lift the axle box'):
        WheelInverse(vehicle(modes=(WheelMode(100.0, 0.01, 0.1, -0.1),)), 1.0 / RATE, 1)
