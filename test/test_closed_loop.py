"""Measured minus predicted at the wheels behind: the test of the model itself."""

import dataclasses
import math

import numpy as np
import pytest

from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.estimation.closed_loop import BANDS
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import AxleBox, Contact, Vehicle, Wheel

S = 1_000_000_000
START = 1_700_000_000 * S
RATE = 25600.0
TRACK = load_track('blanco_table_3_1')
BOGIE = Vehicle('bogie', Wheel(550.0, 100e3, 0.46), Contact(100e9, 1.5),
                (AxleBox('lead', 'left', 0.0), AxleBox('trail', 'left', -2.5)))


@pytest.fixture(scope='module')
def measured():
    """Accelerations (n, 2) of both axle boxes at 25 m/s, from another mesh and finer steps."""
    x = 25.0 * np.arange(round(2.2 * 2 * RATE)) / (2 * RATE)
    r = iso3095(80.0, seed=3, start=-5.0).at(x[:, None] + np.array([0.0, -2.5]))
    forward = RecursiveForward(make_bay(TRACK, Mesh(10)), BOGIE, [0.0, -2.5], 0.5 / RATE, 0.0,
                               hold='linear', maximum_frequency=8000.0)
    return forward.run(x, r).axle_box_acceleration[::2]


def fed(estimator, a, size=512, first=0, last=None, speed=25.0, start=START):
    if first == 0:
        for k in range(-10, math.ceil(len(a) / RATE * 100) + 2):
            estimator.add_speed(start + k * S // 100, speed)
    for k in range(first, last or len(a), size):
        part = a[k:min(k + size, last or len(a))]
        estimator.process(start + round(k / RATE * S), np.arange(len(part)) / RATE,
                          {'lead': part[:, 0], 'trail': part[:, 1]})
    return estimator


def test_the_right_track_explains_the_wheel_behind_and_a_wrong_one_does_not(measured):
    right = fed(Estimator(TRACK, BOGIE), measured).model_residual()
    assert list(right) == ['trail']
    assert list(right['trail']) == list(BANDS)
    soft = dataclasses.replace(TRACK, support=dataclasses.replace(
        TRACK.support, pad_stiffness=0.6 * TRACK.support.pad_stiffness))
    wrong = fed(Estimator(soft, BOGIE), measured).model_residual()
    for band in ('100-400 Hz', '400-1000 Hz', '1000-2000 Hz'):
        assert right['trail'][band].share < 0.05
        assert wrong['trail'][band].share > 2.0 * right['trail'][band].share
        assert right['trail'][band].measured > 0.5


def test_running_backwards_the_other_wheel_leads(measured):
    # The same way in the other direction: the front wheel of the run is the rear of the vehicle.
    turned = measured[:, ::-1]
    estimator = Estimator(dataclasses.replace(TRACK, name='turned'), dataclasses.replace(
        BOGIE, axle_boxes=(AxleBox('lead', 'left', 2.5), AxleBox('trail', 'left', 0.0))))
    found = fed(estimator, turned, speed=-25.0).model_residual()
    assert list(found) == ['lead']
    assert found['lead']['400-1000 Hz'].share < 0.05


def test_residual_does_not_depend_on_blocks_and_survives_being_saved(measured):
    blank = Estimator(TRACK, BOGIE)
    whole = fed(blank, measured).model_residual()
    assert fed(Estimator(TRACK, BOGIE), measured, size=700).model_residual() == whole
    first, second = Estimator(TRACK, BOGIE), Estimator(TRACK, BOGIE)
    middle = 60 * 512  # within the test
    fed(first, measured, last=middle)
    assert first.model_residual() == {}
    second.restore(first.state())
    assert fed(second, measured, first=middle).model_residual() == whole


def test_after_a_gap_the_same_models_serve_and_give_what_new_ones_would(measured):
    found = []
    for anew in (False, True):
        estimator = fed(Estimator(TRACK, BOGIE), measured, last=60 * 512)  # breaks off in a test
        loop = estimator._rails[0].loop
        assert loop._testing
        if anew:
            loop.time_step = 0.0  # of another sample rate, so its models cannot serve
        fed(estimator, measured, start=START + 3 * S)
        assert (estimator._rails[0].loop._models is loop._models) is not anew
        found.append(estimator.model_residual())
    assert found[0] == found[1]
    assert found[0]['trail']['400-1000 Hz'].share < 0.05


def test_a_faulty_sensor_is_told_by_the_residual_of_its_own_box(measured):
    weak = measured * [1.0, 0.7]
    found = fed(Estimator(TRACK, BOGIE), weak).model_residual()
    for band in ('100-400 Hz', '400-1000 Hz'):
        assert found['trail'][band].share > 0.3


def test_samples_too_far_apart_for_a_forward_run_are_estimated_without_a_test():
    """Sensors of 1 kHz: the wheel on its contact spring is faster than they can follow."""
    estimator = Estimator(TRACK, BOGIE)
    a = np.random.default_rng(2).normal(0.0, 3.0, (1500, 2))
    for k in range(-10, 152):
        estimator.add_speed(START + k * S // 100, 25.0)
    for k in range(0, 1500, 50):
        block = estimator.process(START + k * S // 1000, np.arange(50) / 1000.0,
                                  {'lead': a[k:k + 50, 0], 'trail': a[k:k + 50, 1]})
    assert np.isfinite(block.irregularity['trail']).all()
    assert not estimator.model_residual()


def test_a_dead_box_leaves_nothing_to_test(measured):
    dead = measured.copy()
    dead[:, 1] = np.nan
    assert fed(Estimator(TRACK, BOGIE), dead).model_residual() == {}
