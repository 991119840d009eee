"""Convolution and recursion repeat the full model of the same mesh and time step."""

import dataclasses

import numpy as np
import pytest

from railtrack_ros.dynamics.irf import LEFT, MEMORY, IrfForward, memory_of
from railtrack_ros.dynamics.modes import make_track_modes
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import MAXIMUM_FREQUENCY, RecursiveForward
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

TRACK = load_track('blanco_table_3_1')
VEHICLE = load_vehicle('blanco_table_3_1')
STEP = 2.5e-5


def bay_of(kind, mesh=None, loss=0.0):
    return make_bay(dataclasses.replace(
        TRACK, support=dataclasses.replace(TRACK.support, kind=kind),
        rail=dataclasses.replace(TRACK.rail, loss_factor=loss)), mesh)


def rough_run(offsets, speed=10.0, acceleration=60.0, duration=0.25):
    """Positions and a smooth random irregularity of some micrometres, fading in."""
    t = np.arange(round(duration / STEP)) * STEP
    position = speed * t + 0.5 * acceleration * t**2
    x = np.arange(-5.0, 25.0, 0.01)
    profile = np.convolve(np.random.default_rng(1).standard_normal(x.size) * 4e-6,
                          np.hanning(9) / 4.0, 'same') * np.clip(x, 0.0, 1.0)
    irregularity = np.stack([np.interp(position + o, x, profile) for o in offsets], axis=1)
    return position, irregularity


def relative(found, reference):
    """Rms of the difference over the rms of the reference's own variation."""
    return np.std(found - reference) / np.std(reference)


@pytest.mark.parametrize(('kind', 'mesh', 'hertz', 'cut_off'), [
    ('concentrated', Mesh(6), MAXIMUM_FREQUENCY, 0.002),
    ('concentrated', Mesh(6), 20000.0, 0.001),
    ('distributed', Mesh(6), MAXIMUM_FREQUENCY, 0.004),
    ('distributed', Mesh(6), 20000.0, 0.001),
    ('distributed', Mesh(4, 1, 'dynamic', modes_per_element=3), MAXIMUM_FREQUENCY, 0.006),
])
def test_convolution_and_recursion_repeat_the_full_model(kind, mesh, hertz, cut_off):
    """Left is the end of the memory for one, the poles above the cut-off for the other."""
    bay = bay_of(kind, mesh, loss=0.02)
    offsets = [0.0, -2.5]
    position, irregularity = rough_run(offsets)
    reference = FullModel(bay, VEHICLE, offsets, STEP, 0.0).run(position, irregularity)
    convolution = IrfForward(bay, VEHICLE, offsets, STEP, 0.0).run(position, irregularity)
    recursion = RecursiveForward(
        bay, VEHICLE, offsets, STEP, 0.0, maximum_frequency=hertz).run(position, irregularity)
    for found, limit in ((convolution, 0.004), (recursion, cut_off)):
        assert relative(found.contact_force, reference.contact_force) < limit
        deflection = found.rail_deflection - reference.rail_deflection
        assert np.sqrt(np.mean(deflection**2)) < 1e-3 * abs(reference.rail_deflection.mean())


def test_all_poles_repeat_the_full_model_to_the_closure_of_the_ring():
    """With no pole cut off what is left is the ring's closure and rounding."""
    bay = bay_of('distributed', Mesh(6), loss=0.02)
    position, irregularity = rough_run([0.0])
    reference = FullModel(bay, VEHICLE, [0.0], STEP, 0.0).run(position, irregularity)
    found = RecursiveForward(make_track_modes(bay, 91, 1e9), VEHICLE, [0.0], STEP, 0.0).run(
        position, irregularity)
    assert relative(found.contact_force, reference.contact_force) < 1e-5


@pytest.mark.parametrize('solver', [FullModel, IrfForward, RecursiveForward])
class TestEverySolver:
    def test_smooth_track_forces_wheel_and_rail_as_published(self, solver):
        """Table 3.1 on distributed supports at 24 m/s, loss factor 0: 98.90 .. 100.92 kN."""
        step = 5e-5
        position = 24.0 * np.arange(round(12.6 / 24.0 / step)) * step
        run = solver(bay_of('distributed', Mesh(8)), VEHICLE, [0.0], step, 0.0)
        force = run.run(position, np.zeros((position.size, 1))).contact_force[position > 11.4]
        assert force.min() == pytest.approx(98.90e3, abs=150.0)
        assert force.max() == pytest.approx(100.92e3, abs=150.0)

    def test_wheels_at_rest_stay_at_rest(self, solver):
        run = solver(bay_of('distributed', Mesh(6)), VEHICLE, [0.0, -2.5], STEP, 1.23)
        result = run.run(np.full(2000, 1.23), np.zeros((2000, 2)))
        np.testing.assert_allclose(result.contact_force, 100e3, rtol=1e-6)
        np.testing.assert_allclose(result.rail_deflection, result.rail_deflection[:1] + np.zeros(
            (2000, 1)), rtol=1e-6)

    def test_a_deep_dip_unloads_the_contact_and_the_wheel_comes_down_again(self, solver):
        position = 20.0 * np.arange(3000) * STEP
        dip = -3e-3 * np.exp(-((position - 0.7) / 0.03) ** 2)
        result = solver(bay_of('distributed', Mesh(6)), VEHICLE, [0.0], STEP, 0.0).run(
            position, dip[:, None])
        force = result.contact_force[:, 0]
        assert force.min() == 0.0
        flying = force == 0.0
        assert flying.sum() > 20
        np.testing.assert_allclose(
            result.axle_box_acceleration[flying, 0], -100e3 / 550.0, rtol=1e-9)
        assert force[np.flatnonzero(flying)[-1]:].max() > 150e3

    def test_a_run_in_pieces_is_the_run_in_one(self, solver):
        bay = bay_of('distributed', Mesh(6))
        position, irregularity = rough_run([0.0, -2.5], duration=0.06)
        whole = solver(bay, VEHICLE, [0.0, -2.5], STEP, 0.0).run(position, irregularity)
        pieces = solver(bay, VEHICLE, [0.0, -2.5], STEP, 0.0)
        cuts = [0, 1, 2, 700, 701, position.size]
        force = np.concatenate([pieces.run(position[a:b], irregularity[a:b]).contact_force
                                for a, b in zip(cuts, cuts[1:], strict=False)])
        # The convolution takes its responses from a longer window when a piece needs them.
        np.testing.assert_allclose(
            force, whole.contact_force, rtol=1e-4 if solver is IrfForward else 1e-12)

    def test_what_cannot_run_is_refused(self, solver):
        bay = bay_of('distributed', Mesh(6))
        with pytest.raises(InputError, match='time step'):
            solver(bay, VEHICLE, [0.0], 0.0, 0.0)
        run = solver(bay, VEHICLE, [0.0], STEP, 0.0)
        with pytest.raises(InputError, match='starts at'):
            run.run(np.array([5.0]), np.zeros((1, 1)))
        with pytest.raises(InputError, match='finite'):
            run.run(np.array([0.0, 0.01]), np.array([[0.0], [np.nan]]))


def test_too_short_a_memory_is_refused():
    with pytest.raises(InputError, match='memory'):
        IrfForward(bay_of('distributed', Mesh(6)), VEHICLE, [0.0], STEP, 0.0, memory=1e-5)


def damped(pad, ballast, loss=0.02):
    support = dataclasses.replace(
        TRACK.support, kind='distributed', pad_damping=pad, ballast_damping=ballast)
    return make_bay(dataclasses.replace(
        TRACK, support=support, rail=dataclasses.replace(TRACK.rail, loss_factor=loss)), Mesh(4))


def test_the_memory_is_as_long_as_the_track_rings():
    ordinary, ringing, undamped = damped(48e3, 47e3), damped(10e3, 10e3), damped(0.0, 0.0, 0.0)
    assert memory_of(ordinary) == MEMORY[0]
    assert MEMORY[0] < memory_of(ringing) < MEMORY[1] == memory_of(undamped)
    left = [IrfForward(bay, VEHICLE, [0.0], 1e-4, 0.0).left
            for bay in (ordinary, ringing, undamped)]
    assert max(left[:2]) <= LEFT < left[2]
    assert IrfForward(ringing, VEHICLE, [0.0], 1e-4, 0.0, memory=0.1).left > 5.0 * LEFT


def test_convolution_repeats_the_full_model_on_a_track_that_rings_for_long():
    bay, step = damped(10e3, 10e3), 1e-4
    position = 20.0 * step * np.arange(4000)
    irregularity = 1e-5 * np.sin(2.0 * np.pi * position / 0.5)[:, None]
    reference = FullModel(bay, VEHICLE, [0.0], step, 0.0).run(position, irregularity)
    error = [relative(IrfForward(bay, VEHICLE, [0.0], step, 0.0, memory).run(
        position, irregularity).rail_deflection, reference.rail_deflection)
        for memory in (None, 0.1)]
    assert error[0] < 0.02
    assert error[1] > 5.0 * error[0]
