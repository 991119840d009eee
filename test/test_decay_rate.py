"""Track decay rate after EN 15461."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from frequency_domain import variant

from railtrack_ros.dynamics import decay_rate as decay
from railtrack_ros.dynamics.dispersion import DECIBELS, bloch_wavenumbers


@pytest.mark.parametrize('exponent', [0.1, 0.3, 1.0])
def test_an_exponential_decay_is_read_as_its_own_rate(exponent):
    distance = decay.GRID_IN_BAYS * 0.6
    squared = np.exp(-2.0 * exponent * distance)[:, None]
    rate = decay.decay_rate(distance, squared)
    assert rate[0] == pytest.approx(DECIBELS * exponent, rel=0.03)


def test_a_rail_that_does_not_decay_reads_the_floor(table_3_1):
    distance = decay.GRID_IN_BAYS * 0.6
    rate = decay.decay_rate(distance, np.ones((distance.size, 1)))
    floor = decay.track_decay_rate(table_3_1).floor
    assert floor == pytest.approx(4.343 / 39.6, rel=1e-4)
    assert 0.8 * floor < rate[0] <= floor


def test_positions_stand_for_the_rail_half_way_to_their_neighbours():
    # 4.343 / (1 * 0.5 + 0.5 * 1.5 + 0.25 * 2)
    rate = decay.decay_rate([0.0, 1.0, 3.0], [[4.0], [2.0], [1.0]])
    assert rate[0] == pytest.approx(4.342945 / 1.75, rel=1e-6)


def test_decay_rates_of_table_3_1(table_3_1):
    # Indicative values of an independent computation on a coarser grid.
    result = decay.track_decay_rate(table_3_1)
    expected = {200: 6.0, 315: 19.7, 500: 12.7, 630: 8.3, 800: 5.4, 1000: 3.8}
    rates = dict(zip(result.frequency, result.rate, strict=True))
    for frequency, rate in expected.items():
        assert rates[frequency] == pytest.approx(rate, rel=0.05)


def test_high_frequencies_decay_as_the_propagating_wave(table_3_1):
    # Well above the pinned-pinned frequency one wave is left, and the near field is short.
    result = decay.track_decay_rate(table_3_1)
    wave = -DECIBELS * bloch_wavenumbers(table_3_1, decay.CENTRES)[:, 0].imag
    high = result.frequency >= 2000.0
    np.testing.assert_allclose(result.rate[high], wave[high], rtol=0.15)


def test_stiffer_pads_block_waves_up_to_higher_frequency(table_3_1):
    soft, stiff = (decay.track_decay_rate(variant(table_3_1, pad_stiffness=k)).rate
                   for k in (100e6, 1000e6))
    at = decay.NOMINAL.tolist().index
    assert stiff[at(630.0)] > 3.0 * soft[at(630.0)]


def test_what_misses_the_limit_is_named(table_3_1):
    good = decay.track_decay_rate(table_3_1)
    assert decay.below_limit(good).size == 0
    poor = decay.track_decay_rate(variant(table_3_1, 0.001, pad_stiffness=60e6, pad_damping=2e3))
    named = decay.below_limit(poor)
    assert {400.0, 500.0, 630.0} <= set(named)
    assert (poor.rate[np.isin(poor.frequency, named)] < 6.0).all()


def test_plausible_hard_pads_explain_measured_decay_rates(reference_data):
    path = Path(__file__).parents[1] / 'benchmarks' / 'measured_decay_rates.py'
    spec = importlib.util.spec_from_file_location('measured_decay_rates', path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    measured = script.measurements(reference_data)
    assert len(measured) == 16
    mean = 10.0 ** np.log10(measured).mean(axis=0)
    # The fit of docs/measured_decay_rates.md.
    track = script.plausible_track({
        'pad_stiffness': 922e6, 'pad_damping': 25.5e3, 'ballast_stiffness': 20e6,
        'ballast_damping': 83e3, 'loss_factor': 0.0143})
    rate = decay.track_decay_rate(track).rate
    fitted = decay.NOMINAL <= script.HIGHEST_FITTED
    difference = script.level_difference(rate, mean)[fitted]
    spread = script.level_difference(measured, mean)[:, fitted]
    assert script.rms(difference) < 1.4  # dB
    assert script.rms(difference) < script.rms(spread)
