"""Ring modes against the ring's own matrices, and the recursion against them."""

import dataclasses

import numpy as np
import pytest

from railtrack_ros.dynamics.modes import make_track_modes, ring_length, slowest_wave
from railtrack_ros.dynamics.recursion import step_of
from railtrack_ros.dynamics.recursive import RecursiveResponse
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import load_track

TRACK = load_track('blanco_table_3_1')
BAYS = 9


def ring_matrices(bay, bays):
    """Dense matrices of the closed ring, the obvious way."""
    size = bay.dofs * bays
    result = []
    for local in (bay.stiffness, bay.damping, bay.mass):
        full = np.zeros((size, size))
        for m in range(bays):
            slots = [*range(m * bay.dofs, (m + 1) * bay.dofs),
                     *((((m + 1) % bays) * bay.dofs + k) for k in range(2))]
            full[np.ix_(slots, slots)] += local
        result.append(full)
    return result


def ring_shape(bay, bays, x):
    """N(x) over all degrees of freedom of the ring."""
    number, inside = bay.locate([x])
    full = np.zeros(bay.dofs * bays)
    weights = bay.shape(inside)[0]
    m = int(number[0]) % bays
    full[m * bay.dofs:(m + 1) * bay.dofs] = weights[:bay.dofs]
    full[((m + 1) % bays) * bay.dofs + np.arange(2)] += weights[bay.dofs:]
    return full


@pytest.fixture(scope='module', params=['concentrated', 'distributed', 'dynamic'])
def bay(request):
    kind = 'distributed' if request.param == 'dynamic' else request.param
    track = dataclasses.replace(
        TRACK, support=dataclasses.replace(TRACK.support, kind=kind))
    if request.param == 'dynamic':
        return make_bay(track, Mesh(4, 1, 'dynamic', modes_per_element=3))
    return make_bay(track, Mesh(6))


@pytest.mark.parametrize('places', [(0.3, 0.3), (0.07, 1.3), (1.3, 0.07), (-0.55, 0.2)])
def test_all_modes_together_are_the_receptance_of_the_ring(bay, places):
    modes = make_track_modes(bay, BAYS, maximum_frequency=1e9)
    k, c, m = ring_matrices(bay, BAYS)
    at, force = places
    for hertz in (5.0, 90.0, 700.0, 2500.0):
        w = 2.0 * np.pi * hertz
        dynamic = k + 1j * w * c - w**2 * m
        direct = ring_shape(bay, BAYS, at) @ np.linalg.solve(
            dynamic, ring_shape(bay, BAYS, force))
        if at == force:
            direct += bay.flexibility(bay.locate([at])[1])[0]
        assert modes.receptance(hertz, at, force)[0] == pytest.approx(direct, rel=1e-6)


def test_reciprocity(bay):
    modes = make_track_modes(bay, BAYS)
    there, back = modes.receptance([80.0, 1000.0], 0.1, 1.7), modes.receptance(
        [80.0, 1000.0], 1.7, 0.1)
    np.testing.assert_allclose(there, back, rtol=1e-9)


def test_every_pole_decays(bay):
    assert make_track_modes(bay, BAYS, 1e9).poles.real.max() < 0.0


def test_cut_off_poles_leave_their_static_share(bay):
    whole = make_track_modes(bay, BAYS, 1e9)
    cut = make_track_modes(bay, BAYS, 3000.0)
    assert cut.poles.size < whole.poles.size
    np.testing.assert_allclose(cut.receptance(0.01, 0.22, 0.22),
                               whole.receptance(0.01, 0.22, 0.22), rtol=1e-6)


def test_settled_rail_stays_where_it_is(bay):
    """The shapes are cubics in pieces of a bay, in single precision."""
    modes = make_track_modes(bay, BAYS)
    place, force = np.array([0.11, -2.39]), np.array([-1e5, -8e4])
    response = RecursiveResponse(modes, 1e-4, place)
    response.settle(0.0, force)
    w = response.deflection(np.zeros(500), np.tile(force, (500, 1)))
    np.testing.assert_allclose(w, np.tile(w[0], (500, 1)), rtol=1e-10)
    k = ring_matrices(bay, BAYS)[0]
    shapes = np.stack([ring_shape(bay, BAYS, x) for x in place])
    static = shapes @ np.linalg.solve(k, shapes.T @ force)
    static += bay.flexibility(bay.locate(place)[1]) * force
    np.testing.assert_allclose(w[0], static, rtol=1e-7)


@pytest.mark.parametrize('hold', ['linear', 'trapezoidal'])
def test_recursion_converges_to_the_continuous_response_with_the_square_of_the_step(bay, hold):
    """A standing sine force after a long time has the deflection of the receptance."""
    modes = make_track_modes(bay, BAYS, 3000.0)
    hertz = 400.0
    exact = modes.receptance(hertz, 0.2, 0.2)[0]
    errors = []
    for step in (8e-5, 4e-5):
        t = np.arange(round(0.3 / step)) * step
        drive = np.exp(2j * np.pi * hertz * t)
        x = np.full(t.size, 0.2)
        parts = [RecursiveResponse(modes, step, [0.0], hold).deflection(x, part[:, None])[:, 0]
                 for part in (drive.real, drive.imag)]
        found = (parts[0] + 1j * parts[1])[-1] / drive[-1]
        errors.append(abs(found / exact - 1.0))
    assert errors[1] < 0.02
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)


def test_results_do_not_depend_on_the_block_size(bay):
    modes = make_track_modes(bay, BAYS)
    rng = np.random.default_rng(5)
    t = np.arange(1200) / 20000.0
    lead = 3.0 + 20.0 * t - 200.0 * t**2 / 2.0 * 2.0  # slows down and turns back
    f = -1e5 + 1e4 * rng.standard_normal((lead.size, 2))
    whole = RecursiveResponse(modes, 5e-5, [0.0, -2.5]).deflection(lead, f)
    piecewise = RecursiveResponse(modes, 5e-5, [0.0, -2.5])
    cuts = [0, 1, 2, 100, 777, 1200]
    parts = [piecewise.deflection(lead[a:b], f[a:b]) for a, b in zip(cuts, cuts[1:], strict=False)]
    assert np.array_equal(np.concatenate(parts), whole)


def test_saved_state_continues_to_the_last_bit(bay):
    modes = make_track_modes(bay, BAYS)
    x = np.linspace(0.0, 2.0, 800)
    f = np.full((800, 1), -1e5)
    first = RecursiveResponse(modes, 5e-5, [0.0])
    first.deflection(x[:400], f[:400])
    second = RecursiveResponse(modes, 5e-5, [0.0])
    second.restore(first.state())
    assert np.array_equal(second.deflection(x[400:], f[400:]), first.deflection(x[400:], f[400:]))


def test_slow_poles_keep_their_digits_in_the_recursion():
    step = step_of(np.array([-1e-3 + 0j, -50.0 + 3j]), 1e-6, 'linear')
    np.testing.assert_allclose(step.p1.real, 0.5e-6, rtol=1e-4)
    np.testing.assert_allclose(step.p0.real, 0.5e-6, rtol=1e-4)


def test_impossible_time_step_and_ring_are_refused(bay):
    modes = make_track_modes(bay, BAYS)
    with pytest.raises(InputError, match='time step'):
        RecursiveResponse(modes, 0.0, [0.0])
    with pytest.raises(InputError, match='hold'):
        RecursiveResponse(modes, 1e-4, [0.0], hold='cubic')
    with pytest.raises(InputError, match='ring'):
        make_track_modes(bay, 1)


def test_two_oscillators_stand_for_the_cut_off_poles_up_to_half_the_cut_off(bay):
    whole, cut = make_track_modes(bay, BAYS, 1e9), make_track_modes(bay, BAYS, 6000.0)
    hertz = [10.0, 1000.0, 2000.0, 3000.0]
    for x in (0.0, 0.05, 0.13, 0.3):
        error = np.abs(cut.receptance(hertz, x, x) / whole.receptance(hertz, x, x) - 1.0)
        assert (error < [1e-9, 1e-4, 1e-3, 1e-2]).all()


@pytest.mark.parametrize('name', ['blanco_table_3_1', 'blanco_table_2_1', 'mainline_soft_pads'])
def test_ring_is_as_long_as_its_waves_need(name):
    """The closure of the chosen ring against a ring of 501 bays, over 20 to 3000 Hz."""
    bay = make_bay(load_track(name), Mesh(6))
    length = ring_length(bay, [0.0])
    f = np.arange(20.0, 3000.0, 20.0)
    endless = make_track_modes(bay, 501).receptance(f, 0.3, 0.3)

    def error(bays):
        ratio = make_track_modes(bay, bays).receptance(f, 0.3, 0.3) / endless
        return np.sqrt(np.mean(np.abs(ratio - 1.0) ** 2))

    assert error(length) < 1.5e-3
    assert error(length // 2) > 5e-3
    assert ring_length(bay, [0.0, -6.0]) in range(
        length + round(6.0 / bay.spacing), length + round(6.0 / bay.spacing) + 3)


def test_waves_decay_between_bays_as_the_infinite_track_says(bay):
    """Receptance from bay to bay far from the load, where the slowest wave is left alone."""
    modes = make_track_modes(bay, 201, 1e9)
    for hertz in (700.0, 1000.0):
        far = [abs(modes.receptance(hertz, 0.2 + 0.6 * m, 0.2)[0]) for m in (30, 40)]
        assert (far[1] / far[0]) ** 0.1 == pytest.approx(slowest_wave(bay, hertz)[0], rel=1e-3)


def test_corrected_hold_follows_a_wave_at_a_tenth_of_the_sample_rate(bay):
    """A standing sine force: linear hold loses sinc^2, the corrected one almost nothing."""
    modes, step, hertz = make_track_modes(bay, BAYS), 4e-5, 2500.0
    exact = modes.receptance(hertz, 0.2, 0.2)[0]
    t = np.arange(4000) * step
    drive = np.exp(2j * np.pi * hertz * t)
    x = np.full(t.size, 0.2)
    error = {}
    for hold in ('linear', 'corrected'):
        parts = [RecursiveResponse(modes, step, [0.0], hold).deflection(x, part[:, None])[:, 0]
                 for part in (drive.real, drive.imag)]
        error[hold] = abs((parts[0] + 1j * parts[1])[-1] / drive[-1] / exact - 1.0)
    assert error['linear'] > 0.03
    assert error['corrected'] < 0.01
