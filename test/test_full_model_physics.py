"""The full model's figures: energy, slope of the force at nodes, window, meshes, iterations."""

import dataclasses
import pickle

import numpy as np
import pytest

from railtrack_ros.dynamics.forward import StepFailure
from railtrack_ros.dynamics.irf import IrfForward
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.figures.evidence_time import energy_defect
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

TABLE_2_1, TABLE_3_1 = load_track('blanco_table_2_1'), load_track('blanco_table_3_1')
WHEEL = load_vehicle('blanco_table_3_1')
LOAD = WHEEL.wheel.static_load
PAD = PadNonlinearity(preload=20e3, unloaded_stiffness=120e6)


def changed(track, loss=None, **support):
    rail = track.rail if loss is None else dataclasses.replace(track.rail, loss_factor=loss)
    return dataclasses.replace(track, rail=rail,
                               support=dataclasses.replace(track.support, **support))


def drive(track, position, irregularity=None, offsets=(0.0,), step=50e-6, vehicle=WHEEL,
          **options):
    model = FullModel(track, vehicle, offsets, step, position[0], **options)
    if irregularity is None:
        irregularity = np.zeros((len(position), len(offsets)))
    return model.run(position, irregularity)


def rough(position, factor=1.0, seed=5):
    return factor * profile.iso3095(80.0, 1e-3, seed, -20.0).at(position[:, None])


# --- energy -----------------------------------------------------------------------------------

def test_physical_energy_balance_converges_with_the_square_of_the_step():
    steps = 40e-6 / 2.0 ** np.arange(4)
    defects, exchanged = np.array([energy_defect(step) for step in steps]).T
    assert np.log2(defects[:-1] / defects[1:]) == pytest.approx(2.0, abs=0.25)
    assert abs(defects[-1]) < 1e-3 * exchanged[-1]


# --- thesis figures 2.5 and 2.6 ---------------------------------------------------------------

def slope_jumps(elements, local_system, reach=5e-3):
    """Jumps [N/m] of the contact force's slope at the nodes of one bay, the sleeper's first.

    One-sided cubics over `reach`, half the length of a contact patch, at a step of 41 um.
    """
    vehicle = load_vehicle('blanco_table_2_1')
    bay = make_bay(changed(TABLE_2_1, 0.0, kind='concentrated'),
                   Mesh(elements, local_system=local_system))
    position = 148.0 / 3.6 * 1e-6 * np.arange(round(4.5 * 3.6 / 148.0 / 1e-6))
    force = drive(bay, position, step=1e-6, vehicle=vehicle).contact_force[:, 0]
    nodes = bay.nodes[:-1] + bay.start
    jumps = []
    for node in 5 * bay.spacing + nodes[np.argsort(np.abs(nodes))]:
        slopes = []
        for side in (-1.0, 1.0):
            way = side * (position - node)
            near = (way > 0.0) & (way < reach)
            slopes.append(np.polyfit(position[near] - node, force[near], 3)[-2])
        jumps.append(slopes[1] - slopes[0])
    return np.array(jumps)


def test_dynamic_local_system_removes_the_jumps_of_slope_between_sleepers():
    static, dynamic = slope_jumps(8, 'static'), slope_jumps(4, 'dynamic')
    assert np.abs(static[1:]).min() > 500e3
    assert np.abs(dynamic[1:]).max() < 0.1 * np.abs(static[1:]).max()
    assert dynamic[0] < -200e3  # above a point support it is physical


def test_two_and_eight_elements_agree_with_the_dynamic_local_system():
    vehicle = load_vehicle('blanco_table_2_1')
    speed = 148.0 / 3.6
    position = speed * 25e-6 * np.arange(round(10.0 / speed / 25e-6))
    irregularity = rough(position, 0.3) * np.clip(position, 0.0, 1.0)[:, None]
    forces = [drive(make_bay(changed(TABLE_2_1, kind='concentrated'),
                             Mesh(n, local_system='dynamic')), position, irregularity,
                    step=25e-6, vehicle=vehicle).contact_force for n in (2, 8)]
    assert np.std(forces[0] - forces[1]) < 0.01 * np.std(forces[1])


# --- the window -------------------------------------------------------------------------------

def test_window_without_any_loss_in_the_rail_agrees_with_a_long_track():
    bay = make_bay(changed(TABLE_3_1, 0.0, kind='concentrated'), Mesh(4))
    position = 40.0 * 50e-6 * np.arange(8000)
    irregularity = rough(position) * np.clip(position, 0.0, 1.0)[:, None]
    window, long = (drive(bay, position, irregularity, margin=margin).contact_force
                    for margin in (None, 320))
    assert np.abs(window - long).max() < 5e-4 * LOAD


def test_uneven_track_far_from_its_changes_is_the_even_track():
    soft = dataclasses.replace(TABLE_3_1.support, ballast_stiffness=20e6, pad_stiffness=100e6)
    uneven = dataclasses.replace(TABLE_3_1, stretches=(
        Stretch(60.0, 63.0, TABLE_3_1.rail, soft),), sleepers=((-40, soft),))
    position = 40.0 * 50e-6 * np.arange(4000)
    irregularity = rough(position)
    found = drive(BayRow(uneven, Mesh(4)), position, irregularity)
    even = drive(make_bay(TABLE_3_1, Mesh(4)), position, irregularity)
    assert np.abs(found.contact_force - even.contact_force).max() < 5e-4 * LOAD


def test_uneven_track_forwards_and_backwards_finds_the_same_rail_again():
    soft = dataclasses.replace(TABLE_3_1.support, ballast_stiffness=20e6)
    track = dataclasses.replace(TABLE_3_1, sleepers=((3, soft), (4, soft)))
    out = 5.0 * 0.5 * (1.0 - np.cos(2.0 * np.pi * np.arange(12000) / 11000))
    position = np.where(np.arange(12000) < 11000, out, 0.0)
    result = drive(BayRow(track, Mesh(4)), position, margin=20)
    assert np.ptp(position) == pytest.approx(5.0)
    assert result.rail_deflection.min() < 1.2 * result.rail_deflection[0]
    assert result.rail_deflection[-1] == pytest.approx(result.rail_deflection[0], rel=1e-4)


@pytest.mark.parametrize('place', [-14.700000000000001, -23.700000000000003, 0.3, 6000.3])
def test_wheels_whole_bays_apart_stand_at_the_ends_of_bays_of_several_kinds(place):
    # Rounding decides in which bay each of them is, and so of which kind that bay is.
    point = dataclasses.replace(TABLE_3_1.support, kind='concentrated')
    number = round(place / 0.6)
    track = dataclasses.replace(TABLE_3_1, sleepers=tuple(
        (number + k, point) for k in (-15, -14, -9, -4, 0, 1, 5)))
    offsets = [0.0, -9.0, -8.4, -7.2, -6.0, -5.4, -4.2, -3.0, -2.4, 0.6, 3.6]
    row = BayRow(track, Mesh(4, local_system='none'))
    assert len({len(bay.table.breaks) for bay in row.kinds}) == 2
    result = drive(row, np.full(50, place), offsets=offsets, margin=20)
    assert np.abs(result.contact_force - LOAD).max() < 1e-6 * LOAD


def test_memory_does_not_grow_with_the_distance():
    track = dataclasses.replace(TABLE_3_1, sleepers=((7, dataclasses.replace(
        TABLE_3_1.support, ballast_stiffness=20e6)),))
    model = FullModel(BayRow(track, Mesh(2, 1)), WHEEL, (0.0,), 100e-6, 0.0, margin=4)
    sizes = []
    for begin in range(0, 3):
        position = 40.0 * 100e-6 * (2000 * begin + np.arange(2000))
        model.run(position, np.zeros((2000, 1)))
        sizes.append(len(pickle.dumps((model.window.compiled, model.track_state()))))
    # Entries are laid out bay by bay only while several kinds are in the window.
    assert sizes[1] == sizes[2] <= sizes[0]
    assert model.first_bay > 30


# --- supports and wheels ----------------------------------------------------------------------

def test_progressive_pad_with_equal_stiffnesses_is_the_linear_pad():
    track = changed(TABLE_3_1, pad_nonlinearity=PadNonlinearity(60e3, 350e6))
    position = 40.0 * 50e-6 * np.arange(600)
    found = drive(BayRow(track, Mesh(4)), position, rough(position))
    linear = drive(make_bay(TABLE_3_1, Mesh(4)), position, rough(position))
    assert found.contact_force == pytest.approx(linear.contact_force, rel=1e-7)


def test_progressive_pad_is_stiffer_under_the_wheel_and_hanging_sleeper_softer():
    def deflection(**support):
        return -drive(BayRow(changed(TABLE_3_1, **support), Mesh(4)),
                      np.array([0.0])).rail_deflection[0, 0]

    linear = deflection()
    assert deflection(pad_nonlinearity=PAD) < linear
    assert deflection(ballast_lift_off=BallastLiftOff(gap=0.2e-3)) > linear + 0.19e-3
    # Preloaded ballast lets go where the rail lifts, some bays away.
    assert deflection(ballast_lift_off=BallastLiftOff(preload=0.0)) > linear


def test_sprung_mass_follows_slow_irregularity_and_the_force_carries_it():
    vehicle = dataclasses.replace(WHEEL, wheel=dataclasses.replace(
        WHEEL.wheel, suspension=Suspension(4e7, 2e5, 9000.0)))
    bay = make_bay(TABLE_3_1, Mesh(4))
    t = 100e-6 * np.arange(10000)
    height = 1e-3 * np.where(t < 0.8, 0.5 - 0.5 * np.cos(np.pi * t / 0.8), 1.0)
    result = drive(bay, np.full(t.size, 0.3), height[:, None], step=100e-6, vehicle=vehicle)
    # The inertia of wheel and sprung mass, once the transient of the start has died away.
    inertia = (550.0 + 9000.0) * 1e-3 * 0.5 * (np.pi / 0.8) ** 2 * np.cos(np.pi * 0.6 / 0.8)
    assert result.contact_force[6000, 0] - LOAD == pytest.approx(inertia, rel=0.05)
    assert result.wheel_displacement[-1, 0] - result.wheel_displacement[0, 0] == pytest.approx(
        1e-3, rel=1e-3)


@pytest.mark.parametrize('solver', [IrfForward, RecursiveForward])
def test_every_solver_takes_flexible_wheelsets(solver):
    vehicle = dataclasses.replace(WHEEL, wheel=dataclasses.replace(
        WHEEL.wheel, suspension=Suspension(1e6, 2e4, 4000.0),
        modes=(WheelMode(85.0, 0.01, 0.03, -0.035), WheelMode(900.0, 0.005, 0.04, 0.02))))
    bay = make_bay(TABLE_3_1, Mesh(4))
    position = 30.0 * 50e-6 * np.arange(2000)
    irregularity = rough(position)
    reference = drive(bay, position, irregularity, vehicle=vehicle)
    found = solver(bay, vehicle, (0.0,), 50e-6, 0.0).run(position, irregularity)
    for one, other in zip(found.arrays(), reference.arrays(), strict=True):
        assert np.std(one - other) < 0.02 * np.std(other)
    rigid = drive(bay, position, irregularity)
    assert np.std(rigid.axle_box_acceleration - reference.axle_box_acceleration) > 0.1 * np.std(
        reference.axle_box_acceleration)


def test_the_estimator_refuses_what_it_cannot_take():
    with pytest.raises(InputError, match='support.pad_nonlinearity: a linear model'):
        Estimator(changed(TABLE_3_1, pad_nonlinearity=PAD), WHEEL)


# --- iterations -------------------------------------------------------------------------------

def test_fixed_matrix_comes_to_the_same_forces_in_more_iterations():
    bay = make_bay(TABLE_3_1, Mesh(6))
    position = 40.0 * 25e-6 * np.arange(1000)
    models = [FullModel(bay, WHEEL, (0.0, -2.5), 25e-6, 0.0, iteration=iteration)
              for iteration in ('newton', 'fixed')]
    irregularity = np.column_stack([rough(position), rough(position - 2.5)])
    newton, fixed = (model.run(position, irregularity) for model in models)
    assert fixed.contact_force == pytest.approx(newton.contact_force, rel=1e-7)
    assert models[1].iterations > 2 * models[0].iterations


def test_looser_tolerance_takes_fewer_iterations_and_less_digits():
    position = 40.0 * 25e-6 * np.arange(1000)
    row = BayRow(changed(TABLE_3_1, pad_nonlinearity=PAD), Mesh(4))
    tight, loose = (FullModel(row, WHEEL, (0.0,), 25e-6, 0.0, margin=20, tolerance=tolerance)
                    for tolerance in (1e-10, 1e-5))
    difference = tight.run(position, rough(position)).contact_force - loose.run(
        position, rough(position)).contact_force
    assert loose.iterations < tight.iterations
    assert loose.support_iterations < tight.support_iterations
    assert 0.0 < np.abs(difference).max() < 1e-2 * LOAD


def test_fixed_matrix_that_diverges_is_told_with_its_step():
    bay = make_bay(TABLE_3_1, Mesh(2, 1, 'none'))
    position = 10.0 * 400e-6 * np.arange(50)
    with pytest.raises(StepFailure, match='did not converge in time step .*iteration newton'):
        drive(bay, position, rough(position, 20.0), step=400e-6, iteration='fixed')
    drive(bay, position, rough(position, 20.0), step=400e-6)


@pytest.mark.parametrize(('options', 'message'), [
    ({'tolerance': 0.1}, 'tolerance'), ({'iteration': 'magic'}, 'iteration')])
def test_impossible_iterations_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        drive(make_bay(TABLE_3_1), np.array([0.0]), **options)
