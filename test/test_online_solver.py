"""The online solver as a whole: accuracy of its figures, holds, moving responses, cache."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
from scipy import signal

from railtrack_ros.dynamics import cache
from railtrack_ros.dynamics.irf import IrfForward, moving_impulse_response
from railtrack_ros.dynamics.modes import make_track_modes
from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import RecursiveForward, RecursiveResponse
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import AxleBox, load_vehicle

TRACK = load_track('blanco_table_3_1')
VEHICLE = load_vehicle('blanco_table_3_1')
STEP = 2.5e-5
BOGIES = [0.0, -2.5, -9.0, -11.5]


def bay_of(kind, mesh=None):
    support = dataclasses.replace(TRACK.support, kind=kind)
    return make_bay(dataclasses.replace(TRACK, support=support), mesh)


def errors(found, reference, settled):
    """Rms differences: of the force over its own variation, of the deflection over its rms."""
    force = found.contact_force[settled:] - reference.contact_force[settled:]
    deflection = found.rail_deflection[settled:] - reference.rail_deflection[settled:]
    return (np.sqrt(np.mean(force**2)) / np.std(reference.contact_force[settled:]),
            np.sqrt(np.mean(deflection**2) / np.mean(reference.rail_deflection**2)))


@pytest.mark.parametrize(('kind', 'offsets', 'rough', 'speeds'), [
    ('concentrated', [0.0], True, (40.0, 40.0)),
    ('concentrated', BOGIES, False, (10.0, 40.0)),
    ('distributed', [0.0], False, (40.0, 40.0)),
    ('distributed', BOGIES, True, (10.0, 40.0)),
])
def test_forward_force_within_half_a_percent_of_the_full_model(kind, offsets, rough, speeds):
    """A half of the cases of docs/online_solver.md, half as long."""
    t = np.arange(8000) * STEP
    position = speeds[0] * t + 0.5 * (speeds[1] - speeds[0]) * t**2 / t[-1]
    irregularity = np.zeros((t.size, len(offsets)))
    if rough:
        irregularity = iso3095(40.0, seed=3, start=-14.0).at(
            position[:, None] + np.array(offsets))
    bay = bay_of(kind)
    reference = FullModel(bay, VEHICLE, offsets, STEP, 0.0, margin=60).run(position, irregularity)
    found = RecursiveForward(bay, VEHICLE, offsets, STEP, 0.0).run(position, irregularity)
    force, deflection = errors(found, reference, 2000)
    assert force < 0.0045
    assert deflection < 3e-5


@pytest.mark.parametrize(('kind', 'mesh'), [
    ('concentrated', Mesh(6)), ('distributed', Mesh(6)),
    ('distributed', Mesh(4, 1, 'dynamic', modes_per_element=3))])
def test_moving_impulse_response_is_that_of_the_recursion(kind, mesh):
    """A wheel moves on at 35 m/s from the place of an impulse of one time step."""
    bay, step, speed, steps = bay_of(kind, mesh), 5e-5, 35.0, 600
    modes = make_track_modes(bay, 91, 1e9)
    places = np.array([0.02, 0.31])
    # The exact responses leave out what moves above 12 kHz.
    for hold, limit in (('trapezoidal', 1e-5), ('linear', 1e-2)):
        found = moving_impulse_response(bay, step, steps, speed, places, hold)
        for place, h in zip(places, found, strict=True):
            impulse = np.zeros((steps, 1))
            impulse[0] = 1.0
            expected = RecursiveResponse(modes, step, [0.0], hold).deflection(
                place + speed * step * np.arange(steps), impulse)[:, 0]
            assert np.abs(h - expected).max() < limit * np.abs(expected).max()


def test_convolution_and_recursion_agree_with_exact_exponentials():
    bay, step = bay_of('distributed', Mesh(6)), 5e-5
    position = 30.0 * np.arange(4000) * step
    irregularity = iso3095(20.0, seed=2, start=-4.0).at(position[:, None] + [0.0, -2.5])
    a, b = (kind(bay, VEHICLE, [0.0, -2.5], step, 0.0, hold='linear').run(position, irregularity)
            for kind in (IrfForward, RecursiveForward))
    force, deflection = errors(a, b, 1000)
    assert force < 0.005
    assert deflection < 1e-3


def test_exact_exponentials_at_50_us_beat_the_full_model_at_50_us():
    """Against the full model at 5 us, over smooth rail with a wave of 1 kHz."""
    bay, speed = bay_of('distributed', Mesh(6)), 40.0

    def force(kind, step, **options):
        position = speed * np.arange(round(0.15 / step)) * step
        wave = 2e-6 * np.sin(2.0 * math.pi * position / 0.04) * np.clip(position, 0.0, 1.0)
        found = kind(bay, VEHICLE, [0.0], step, 0.0, **options).run(position, wave[:, None])
        return found.contact_force[::round(5e-5 / step), 0][1000:]

    fine = force(FullModel, 5e-6)
    exact = force(RecursiveForward, 5e-5, hold='linear')
    newmark = force(FullModel, 5e-5)
    assert np.std(exact - fine) < 0.5 * np.std(newmark - fine)
    assert np.std(exact - fine) < 0.02 * np.std(fine)


def test_saved_forward_run_continues_to_the_last_bit():
    bay = bay_of('distributed', Mesh(6))
    position = 30.0 * np.arange(1500) * STEP
    irregularity = iso3095(20.0, seed=2, start=-4.0).at(position[:, None] + [0.0, -2.5])
    first, second = (RecursiveForward(bay, VEHICLE, [0.0, -2.5], STEP, 0.0) for _ in range(2))
    first.run(position[:700], irregularity[:700])
    second.restore(first.state())
    a, b = (solver.run(position[700:], irregularity[700:]) for solver in (first, second))
    assert np.array_equal(a.contact_force, b.contact_force)


def test_ring_shorter_than_the_vehicle_is_refused():
    with pytest.raises(InputError, match='bays in the ring: expected at least'):
        RecursiveForward(bay_of('distributed', Mesh(6)), VEHICLE, BOGIES, STEP, 0.0, bays=9)


def test_inverse_recovers_one_third_octaves_from_the_full_model_while_accelerating():
    """20 kHz, noise of 0.5 m/s2, 25 to 41 m/s, two wheels; truth: finer mesh, half the period."""
    rate, duration, noise = 20e3, 1.6, 0.5
    t = np.arange(round(duration * 2 * rate)) / (2 * rate)
    x = 25.0 * t + 0.5 * 16.0 / duration * t**2
    r = iso3095(75.0, seed=3, start=-5.0).at(x[:, None] + np.array([0.0, -2.5]))
    truth = FullModel(bay_of('distributed', Mesh(10)), VEHICLE, [0.0, -2.5], 0.5 / rate, 0.0).run(
        x, r)
    a = truth.axle_box_acceleration[::2]
    a = a + noise * np.random.default_rng(0).standard_normal(a.shape)
    names = ('lead', 'trail')
    estimator = Estimator(TRACK, dataclasses.replace(VEHICLE, axle_boxes=tuple(
        AxleBox(name, 'left', offset) for name, offset in zip(names, (0.0, -2.5), strict=True))))
    second = 10**9
    for k in range(-10, 170):
        estimator.add_speed(second + k * second // 100, 25.0 + 16.0 * k / 100 / duration)
    block = estimator.process(second, np.arange(len(a)) / rate, dict(zip(names, a.T, strict=True)))
    x, r = x[::2], r[::2]
    grid = np.arange(14.0, x[-1], 0.0005)
    for w, name in enumerate(names):
        good = np.isfinite(block.contact_force[name])
        error = block.contact_force[name][good] - truth.contact_force[::2, w][good]
        assert np.std(error) < 1.02 * VEHICLE.wheel.mass * noise
        for k in range(4, 21):  # 0.4 m to 10 mm
            edges = [10**(k / 10 - 0.05), 10**(k / 10 + 0.05)]
            band = signal.butter(3, edges, 'bandpass', fs=2000.0, output='sos')
            back, given = (signal.sosfiltfilt(band, np.interp(grid, x, y))[2000:-2000].std()
                           for y in (block.irregularity[name], r[:, w]))
            assert abs(20.0 * math.log10(back / given)) < 0.3


# What is kept on disk


@pytest.fixture
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    return tmp_path / 'tables'


def test_damaged_entry_is_refused_and_made_anew(empty_cache, capsys):
    bay = bay_of('distributed', Mesh(6))
    fresh = make_track_modes(bay, 21)
    (entry,) = cache.entries()
    assert entry.path.parent == empty_cache
    good = entry.path.read_bytes()
    for bad in (good[:-100], good[:500] + bytes([good[500] ^ 1]) + good[501:], b'', b'rubbish'):
        entry.path.write_bytes(bad)
        again = make_track_modes(bay, 21)
        assert np.array_equal(again.poles, fresh.poles)
        assert entry.path.read_bytes() == good
    assert 'damaged' in capsys.readouterr().err
    # From the intact entry nothing is computed.
    assert np.array_equal(make_track_modes(bay, 21).first, fresh.first)
    assert cache.clear() == len(good)
    assert cache.entries() == []


def test_whatever_the_modes_depend_on_makes_another_entry(empty_cache):
    bay = bay_of('distributed', Mesh(6))
    make_track_modes(bay, 21)
    softer = dataclasses.replace(TRACK.support, pad_stiffness=0.999 * TRACK.support.pad_stiffness)
    make_track_modes(make_bay(dataclasses.replace(TRACK, support=softer), Mesh(6)), 21)
    make_track_modes(bay, 23)
    make_track_modes(bay, 21, 6000.0)
    assert len(cache.entries()) == 4


def test_processes_that_start_at_once_share_the_cache(empty_cache):
    code = ("from railtrack_ros.dynamics.modes import make_track_modes\n"
            "from railtrack_ros.track.bay import Mesh, make_bay\n"
            "from railtrack_ros.track.description import load_track\n"
            "modes = make_track_modes(make_bay(load_track('blanco_table_3_1'), Mesh(6)), 31)\n"
            "print(repr(complex(modes.poles.sum())))\n")
    runs = [subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE,
                             stderr=subprocess.PIPE, text=True) for _ in range(3)]
    answers = [run.communicate() for run in runs]
    assert all(run.returncode == 0 for run in runs)
    assert len({out for out, _ in answers}) == 1
    assert [err for _, err in answers] == [''] * 3
    assert len(cache.entries()) == 1
    assert not list(empty_cache.glob('*.part'))
