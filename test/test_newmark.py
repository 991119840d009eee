"""The full model against its plain twin, exact statics, conservation laws and published forces."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from railtrack_ros.dynamics import contact
from railtrack_ros.dynamics.forward import StepFailure
from railtrack_ros.dynamics.newmark import FullModel, assemble, nodal_impulse_responses
from railtrack_ros.errors import InputError
from railtrack_ros.irregularity import profile
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.vehicle.description import load_vehicle

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / 'benchmarks'))

from plain_newmark import PlainModel  # noqa: E402

WHEEL = load_vehicle('blanco_table_3_1')
LOAD = WHEEL.wheel.static_load


def bay_of(track, kind='distributed', loss=0.02, elements=6, local='static', **mesh):
    track = dataclasses.replace(
        track, rail=dataclasses.replace(track.rail, loss_factor=loss),
        support=dataclasses.replace(track.support, kind=kind))
    return make_bay(track, Mesh(elements_per_bay=elements, local_system=local, **mesh))


def drive(bay, position, irregularity=None, offsets=(0.0,), step=25e-6, vehicle=WHEEL, **options):
    model = FullModel(bay, vehicle, offsets, step, position[0], **options)
    if irregularity is None:
        irregularity = np.zeros((len(position), len(offsets)))
    return model.run(position, irregularity)


def at_speed(speed, seconds, step=25e-6, start=0.0):
    return start + speed * step * np.arange(round(seconds / step) + 1)


def rough(position, offsets=(0.0,), factor=1.0, seed=5):
    made = profile.iso3095(60.0, 1e-3, seed=seed, start=-30.0)
    return factor * made.at(position[:, None] + np.array(offsets))


# --- the solution of the equations ---------------------------------------------------------------

@pytest.mark.parametrize(('kind', 'elements', 'local', 'offsets', 'step', 'speed', 'changes'), [
    ('concentrated', 6, 'static', (0.0,), 25e-6, 24.0, {}),
    ('distributed', 5, 'dynamic', (0.0, -2.5), 50e-6, 40.0, {}),
    ('multipoint', 8, 'none', (1.5, 0.0, -0.5), 100e-6, -30.0, {}),
    ('concentrated_rotational', 2, 'static', (0.0, 0.3), 25e-6, 40.0, {'linear': True}),
    ('distributed', 4, 'static', (0.0,), 25e-6, 40.0, {'beta': 0.3025, 'gamma': 0.6}),
])
def test_agrees_with_the_plain_twin(table_3_1, kind, elements, local, offsets, step, speed,
                                    changes):
    newmark = {key: changes[key] for key in ('beta', 'gamma') if key in changes}
    vehicle = WHEEL
    if 'linear' in changes:
        vehicle = dataclasses.replace(vehicle, contact=dataclasses.replace(
            vehicle.contact, stiffness=1.028e9, exponent=1.0))
    bay = bay_of(table_3_1, kind, elements=elements, local=local)
    position = at_speed(speed, 50 * step, step, start=0.21)
    irregularity = rough(position, offsets, factor=3.0)
    twin = PlainModel(bay, vehicle, offsets, step, first_bay=-25, bays=51, **newmark)
    expected = twin.run(position, irregularity)
    got = drive(bay, position, irregularity, offsets, step, vehicle, margin=25, **newmark)
    assert np.abs(np.diff(expected.contact_force, axis=0)).max() > 100.0
    for one, other in zip(got.arrays(), expected.arrays(), strict=True):
        assert np.abs(one - other).max() <= 1e-9 * np.abs(other).max()


@pytest.mark.parametrize('kind', ['concentrated', 'distributed'])
def test_standing_wheels_stay_in_static_equilibrium(table_3_1, kind):
    position = np.full(2000, 0.37)
    result = drive(bay_of(table_3_1, kind), position, offsets=(0.0, -2.5))
    assert np.abs(result.contact_force - LOAD).max() < 1e-6 * LOAD
    assert np.ptp(result.rail_deflection, axis=0).max() < 1e-12


def test_static_deflection_is_that_of_the_exact_track(table_3_1):
    # science of the infinite track, static limit of its receptance: above the sleeper and between
    for kind, between, above in (('concentrated', 7.9329e-9, 7.5497e-9),
                                 ('distributed', 7.7937e-9, 7.5148e-9)):
        bay = bay_of(table_3_1, kind, loss=0.0, elements=8)
        for place, receptance in ((0.3, between), (0.0, above)):
            result = drive(bay, np.array([place]))
            assert result.rail_deflection[0, 0] == pytest.approx(-receptance * LOAD, rel=2e-4)


@pytest.mark.parametrize(('kind', 'least', 'greatest'), [
    ('concentrated', 97.73e3, 101.23e3), ('distributed', 98.90e3, 100.92e3)])
def test_steady_force_on_smooth_rail(table_3_1, kind, least, greatest):
    position = at_speed(24.0, 14.0 / 24.0)
    result = drive(bay_of(table_3_1, kind, loss=0.0, elements=8), position)
    force = result.contact_force[position > 12.0, 0]
    assert force.min() == pytest.approx(least, abs=100.0)
    assert force.max() == pytest.approx(greatest, abs=100.0)


@pytest.mark.parametrize('elements', [2, 4])
def test_steady_force_with_dynamic_local_system_hardly_depends_on_the_mesh(table_2_1, elements):
    vehicle = load_vehicle('blanco_table_2_1')
    bay = bay_of(table_2_1, 'concentrated', loss=0.0, elements=elements, local='dynamic')
    speed = 148.0 / 3.6
    position = at_speed(speed, 14.0 / speed)
    result = drive(bay, position, vehicle=vehicle)
    factor = result.contact_force[position > 12.0, 0] / vehicle.wheel.static_load
    assert factor.min() == pytest.approx(0.939, abs=0.002)
    assert factor.max() == pytest.approx(1.064, abs=0.002)


def test_converges_with_the_square_of_the_time_step(table_3_1):
    # Standing wheel on an irregularity that moves under it: no mesh in the way of the order.
    bay = bay_of(table_3_1, 'distributed', elements=4)
    results = []
    for halvings in range(4):
        step = 200e-6 / 2**halvings
        t = step * np.arange(round(0.02 / step) + 1)
        moved = 2e-5 * (1.0 - np.cos(2.0 * np.pi * 100.0 * t)) ** 2
        result = drive(bay, np.full(t.size, 0.2), moved[:, None], step=step)
        results.append(result.contact_force[::2**halvings, 0])
    change = [np.std(finer - coarser) for coarser, finer in zip(results, results[1:], strict=False)]
    orders = np.log2(np.array(change[:-1]) / change[1:])
    assert orders == pytest.approx(2.0, abs=0.15)


def test_work_identity_closes(table_3_1):
    """Newmark (1/4, 1/2) balances energy step by step: dE = mean force . du - dt v C v."""
    bay = bay_of(table_3_1, 'distributed')
    step = 25e-6
    position = at_speed(30.0, 300 * step, step, start=-0.1)
    offsets = (0.0, -1.8)
    irregularity = rough(position, offsets, factor=5.0)
    model = FullModel(bay, WHEEL, offsets, step, position[0], margin=12)
    mass, damping, stiffness = (assemble(x, model.bays)
                                for x in (bay.mass, bay.damping, bay.stiffness))

    def snapshot(i):
        force = model.run(position[i:i + 1], irregularity[i:i + 1]).contact_force[0]
        u, v, _ = model.track_state()
        number, inside = bay.locate(position[i] + np.array(offsets))
        load = np.zeros_like(u)
        for w, weights in enumerate(bay.shape(inside)):
            begin = (number[w] - model.first_bay) * bay.dofs
            load[begin:begin + bay.dofs + 2] -= weights * force[w]
        return 0.5 * (v @ (mass @ v) + u @ (stiffness @ u)), u, v, load

    energy, u, v, load = snapshot(0)
    first_bay, begun = model.first_bay, energy
    exchanged = worst = 0.0
    for i in range(1, 300):
        energy_new, u_new, v_new, load_new = snapshot(i)
        assert model.first_bay == first_bay
        mean = 0.5 * (v + v_new)
        work = 0.5 * (load + load_new) @ (u_new - u) - step * mean @ (damping @ mean)
        worst = max(worst, abs(energy_new - energy - work))
        exchanged += abs(energy_new - energy)
        energy, u, v, load = energy_new, u_new, v_new, load_new
    assert exchanged > 0.05 * begun
    assert worst < 1e-9 * exchanged


def test_a_run_in_pieces_is_the_same_run(table_3_1):
    bay = bay_of(table_3_1)
    position = at_speed(40.0, 0.05)
    irregularity = rough(position)
    whole = drive(bay, position, irregularity)
    model = FullModel(bay, WHEEL, (0.0,), 25e-6, 0.0)
    cuts = [0, 1, 1, 700, 1501, position.size]
    for begin, end in zip(cuts, cuts[1:], strict=False):
        part = model.run(position[begin:end], irregularity[begin:end])
        for one, other in zip(part.arrays(), whole.part(begin, end).arrays(), strict=True):
            assert np.array_equal(one, other)
    assert model.steps == position.size - 1
    assert model.steps < model.iterations <= model.most_iterations * model.steps


# --- the window -----------------------------------------------------------------------------------

def test_travelling_window_agrees_with_a_long_track(table_3_1):
    bay = bay_of(table_3_1, 'concentrated')
    position = at_speed(40.0, 0.2)
    irregularity = rough(position)
    window = drive(bay, position, irregularity)
    long = drive(bay, position, irregularity, margin=160)
    assert np.abs(window.contact_force - long.contact_force).max() < 5e-4 * LOAD
    assert np.abs(window.rail_deflection - long.rail_deflection).max() < 5e-8


def test_every_bay_is_like_the_others(table_3_1):
    bay = bay_of(table_3_1)
    position = at_speed(40.0, 0.05, start=0.1)
    here = drive(bay, position, rough(position))
    there = drive(bay, position + 5000 * 0.6, rough(position))
    assert np.abs(here.contact_force - there.contact_force).max() < 1e-6 * LOAD


@pytest.mark.parametrize('place', [-14.700000000000001, -23.700000000000003, 0.3, 6000.3])
def test_wheels_whole_bays_apart_stand_at_the_ends_of_bays(table_3_1, place):
    # Rounding decides in which bay each of them is; at the first two places it disagrees.
    bay = bay_of(table_3_1, elements=4)
    assert bay.start == -0.3
    offsets = [0.0, -9.0, -8.4, -7.2, -6.0, -5.4, -4.2, -3.0, -2.4, 0.6, 3.6]
    result = drive(bay, np.full(50, place), offsets=offsets, margin=20)
    assert np.abs(result.contact_force - LOAD).max() < 1e-6 * LOAD


def test_running_backwards_is_the_mirror_image(table_3_1):
    bay = bay_of(table_3_1, elements=6)
    position = at_speed(40.0, 0.06, start=0.1)
    offsets = np.array((0.0, -2.5))
    irregularity = rough(position, offsets)
    forwards = drive(bay, position, irregularity, offsets)
    backwards = drive(bay, -position, irregularity, -offsets)
    for one, other in zip(forwards.arrays(), backwards.arrays(), strict=True):
        assert np.abs(one - other).max() < 2e-5 * np.abs(one).max()


def test_stop_and_reversal_come_to_rest_where_they_began(table_3_1):
    bay = bay_of(table_3_1)
    t = 50e-6 * np.arange(16000)
    position = 0.4 + 0.75 * (1.0 - np.cos(2.0 * np.pi * np.minimum(t, 0.5) / 0.5))
    result = drive(bay, position, step=50e-6)
    assert np.ptp(position) > 2 * bay.spacing
    assert np.abs(result.contact_force[-100:] - LOAD).max() < 1e-5 * LOAD
    assert result.rail_deflection[-1] == pytest.approx(result.rail_deflection[0], rel=1e-6)


# --- contact --------------------------------------------------------------------------------------

def test_wheel_flies_over_a_deep_dip_and_lands(table_3_1):
    bay = bay_of(table_3_1)
    position = at_speed(40.0, 0.06)
    dip = np.where(np.abs(position - 1.15) < 0.15,
                   -1e-3 * (1.0 - np.cos(2.0 * np.pi * (position - 1.0) / 0.3)), 0.0)[:, None]
    result = drive(bay, position, dip)
    force = result.contact_force[:, 0]
    apart = force == 0.0
    fall = -LOAD / WHEEL.wheel.mass
    assert np.array_equal(np.unique(result.axle_box_acceleration[apart]), [fall])
    assert np.all((result.rail_deflection + dip - result.wheel_displacement)[apart] <= 0.0)
    first = int(np.argmax(apart))
    flight = slice(first, first + int(np.argmin(apart[first:])))
    assert 1.0 < position[first] < 1.15 < position[flight.stop] < 1.5
    assert flight.stop - first > 100
    assert np.diff(result.wheel_displacement[flight, 0], 2) == pytest.approx(
        fall * 25e-6**2, rel=1e-5)
    assert force[flight.stop:].max() > 2.0 * LOAD


def test_wheels_on_one_rail_feel_each_other(table_3_1):
    bay = bay_of(table_3_1)
    position = at_speed(40.0, 0.1)
    alone = drive(bay, position, rough(position, (-2.5,)), (-2.5,))
    bogie = drive(bay, position, rough(position, (0.0, -2.5)), (0.0, -2.5))
    between = bogie.contact_force[:, 1] - alone.contact_force[:, 0]
    assert between[0] == 0.0
    assert 0.001 * LOAD < np.std(between) < 0.05 * LOAD


def contact_vibration(damping, stiffness=100e9, exponent=1.5, step=20e-6, count=4000):
    """Indentation of a wheel on a rigid rail that is lifted by 1 um at once."""
    vehicle = dataclasses.replace(WHEEL, contact=dataclasses.replace(
        WHEEL.contact, stiffness=stiffness, exponent=exponent, damping=damping))
    constants = contact.wheel_constants(vehicle, step)
    wheels = contact.standing_wheels(constants, np.zeros(1), np.zeros(1))
    force, work = np.zeros(1), contact.contact_work(1)
    delta = np.zeros(count)
    for i in range(count):
        assert 0 < contact.contact_step(np.zeros(1), np.zeros((1, 1)), np.full(1, 1e-6), wheels,
                                        constants, force, work) < 6
        delta[i] = wheels[contact.INDENTATION, 0]
    return delta - contact.static_indentation(constants)


def test_contact_damping_is_that_of_the_linearised_contact():
    for damping in (0.0, 2.0e4):
        delta = contact_vibration(damping)
        peaks = delta[1:-1][(delta[1:-1] > delta[:-2]) & (delta[1:-1] >= delta[2:])]
        t = 20e-6 * np.flatnonzero((delta[1:-1] > delta[:-2]) & (delta[1:-1] >= delta[2:]))
        rate = -np.polyfit(t[1:12], np.log(peaks[1:12]), 1)[0]
        assert rate == pytest.approx(damping / (2.0 * WHEEL.wheel.mass), abs=0.15)
        frequency = 1.0 / np.diff(t[1:12]).mean()
        tangent = 1.5 * LOAD / 1e-4
        assert frequency == pytest.approx(np.sqrt(tangent / WHEEL.wheel.mass) / (2 * np.pi),
                                          rel=0.01)


def test_damped_contact_never_pulls(table_3_1):
    vehicle = dataclasses.replace(WHEEL, contact=dataclasses.replace(WHEEL.contact, damping=1e5))
    position = at_speed(40.0, 0.08)
    dip = profile.dipped_joint(position, 1.0, 5e-3, 1.0)[:, None]
    damped = drive(bay_of(table_3_1), position, dip, vehicle=vehicle)
    assert damped.contact_force.min() == 0.0
    assert damped.contact_force.max() > 2.0 * LOAD


def test_coupled_contacts_solve_their_equations():
    rng = np.random.default_rng(3)
    n = 5
    constants = contact.wheel_constants(WHEEL, 1e-4)
    half = rng.normal(size=(n, n))
    compliance = 1e-9 * (half @ half.T / n + np.eye(n))
    wheels = contact.standing_wheels(constants, np.zeros(n), np.zeros(n))
    wheels[contact.VELOCITY] = rng.normal(size=n)
    lifted = np.array([5e-4, -1e-3, 0.0, 2e-4, -2e-4])
    force = np.zeros(n)
    before = wheels[0].copy()
    assert contact.contact_step(lifted, compliance, np.zeros(n), wheels, constants, force,
                                contact.contact_work(n)) > 0
    indentation = lifted - compliance @ force - wheels[contact.DISPLACEMENT]
    assert wheels[contact.INDENTATION] == pytest.approx(indentation, abs=1e-15)
    assert force == pytest.approx(100e9 * np.maximum(indentation, 0.0) ** 1.5, rel=1e-9)
    assert (force == 0.0).any()
    assert (force > LOAD).any()
    assert not np.array_equal(before, wheels[0])


# --- impulse responses ----------------------------------------------------------------------------

def test_nodal_impulse_responses_are_reciprocal(table_3_1):
    bay = bay_of(table_3_1, elements=4)
    h = nodal_impulse_responses(bay, 50e-6, steps=60, reach=2, margin=8)
    assert h.shape == (bay.dofs, bay.dofs, 5, 60)
    # Inside one window of finite length, force and response may change places.
    assert np.abs(h - h.transpose(1, 0, 2, 3)[:, :, ::-1]).max() < 1e-9 * np.abs(h).max()


def test_convolved_impulse_responses_repeat_the_full_model(table_3_1):
    """u_n = sum_k h_k f_(n-k), against Newmark steps on assembled matrices."""
    bay, step, reach, margin = bay_of(table_3_1, elements=3), 50e-6, 2, 6
    dofs = [0, 1, bay.sleeper_dof]
    steps = 40
    h = nodal_impulse_responses(bay, step, steps, reach, dofs, margin)
    force = np.random.default_rng(1).normal(size=(3, steps))
    convolved = np.zeros_like(h[0])
    for s in range(3):
        for n in range(steps):
            convolved[..., n] += (h[s, :, :, :n + 1] * force[s, n::-1]).sum(axis=-1)

    bays = 2 * (reach + margin) + 1
    mass, damping, stiffness = (assemble(x, bays).toarray()
                                for x in (bay.mass, bay.damping, bay.stiffness))
    free = np.arange(2, bays * bay.dofs)
    mass, damping, stiffness = (x[np.ix_(free, free)] for x in (mass, damping, stiffness))
    solve = np.linalg.inv(mass + 0.5 * step * damping + 0.25 * step**2 * stiffness)
    u = v = a = np.zeros(free.size)
    rows = np.add.outer((reach + margin) * bay.dofs, dofs) - 2
    answer = [np.array(dofs) + (margin + m) * bay.dofs - 2 for m in range(2 * reach + 1)]
    for n in range(steps):
        load = np.zeros(free.size)
        load[rows] = force[:, n]
        u, v = u + step * v + 0.25 * step**2 * a, v + 0.5 * step * a
        a = solve @ (load - damping @ v - stiffness @ u)
        u, v = u + 0.25 * step**2 * a, v + 0.5 * step * a
        for m, places in enumerate(answer):
            assert convolved[:, m, n] == pytest.approx(u[places], abs=1e-10 * np.abs(h).max())


# --- what is refused ------------------------------------------------------------------------------

def test_failure_names_the_step_and_keeps_the_results_before_it(table_3_1):
    bay = bay_of(table_3_1)
    position = at_speed(40.0, 0.01)
    irregularity = np.zeros((position.size, 1))
    irregularity[200] = 1e250
    with pytest.raises(StepFailure, match=r'time step 200 at position 0\.2 m') as caught:
        drive(bay, position, irregularity)
    kept = caught.value.result.contact_force
    expected = drive(bay, position[:200], irregularity[:200]).contact_force
    assert np.array_equal(kept, expected)


def test_time_step_too_long_for_the_contact_tells_the_longest_that_works(table_3_1):
    longest = contact.longest_time_step(WHEEL)
    with pytest.raises(InputError, match=rf'at most {longest:.2g} s'):
        drive(bay_of(table_3_1), np.array([0.0]), step=1.01 * longest)
    drive(bay_of(table_3_1), np.array([0.0]), step=longest)


@pytest.mark.parametrize(('options', 'message'), [
    ({'step': 0.0}, 'time step'), ({'step': -1e-5}, 'time step'), ({'step': np.nan}, 'time step'),
    ({'offsets': ()}, 'offsets'), ({'offsets': (np.inf,)}, 'offsets'),
    ({'gamma': 0.4}, 'unconditionally'), ({'beta': 0.1}, 'unconditionally'),
    ({'margin': 1}, 'margin'),
])
def test_impossible_set_up_is_refused(table_3_1, options, message):
    with pytest.raises(InputError, match=message):
        drive(bay_of(table_3_1), np.array([0.0]), **options)


@pytest.mark.parametrize(('position', 'irregularity', 'message'), [
    ([1.0, 1.001], None, 'set up to start'),
    ([0.0, 0.4], None, 'too long for the speed'),
    ([0.0, np.nan], None, 'finite'),
    ([0.0, 0.001], np.full((2, 1), np.nan), 'finite'),
    ([0.0, 0.001], np.zeros((2, 2)), r'irregularity \(n, 1\)'),
])
def test_impossible_run_is_refused(table_3_1, position, irregularity, message):
    model = FullModel(bay_of(table_3_1), WHEEL, (0.0,), 25e-6, 0.0, margin=3)
    if irregularity is None:
        irregularity = np.zeros((len(position), 1))
    with pytest.raises(InputError, match=message):
        model.run(np.array(position), irregularity)
