"""Band filters, statistics of a section, and levels of sines that are known."""

import math

import numpy as np
import pytest

from railtrack_ros.estimation import bands as filters
from railtrack_ros.estimation import waves
from railtrack_ros.estimation.limits import load_limits
from railtrack_ros.estimation.wavelengths import mean_spectrum, spectrum

STEP = 1e-3
BANDS = ((0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.0))


def sine(wavelength, amplitude, length=20.0, step=STEP):
    return amplitude * np.sin(2.0 * math.pi * np.arange(round(length / step)) * step / wavelength)


def rms(values):
    return float(np.sqrt(np.nanmean(values**2)))


@pytest.mark.parametrize('band', BANDS)
def test_filters_are_within_a_fifth_of_a_decibel_in_their_pass_band(band):
    """The pass-band of a Butterworth filter is where it is flat: 0.68 of its width in Q."""
    middle = math.sqrt(band[0] * band[1])
    causal = filters.CausalBands((band,), STEP, 1)
    for wavelength in np.geomspace(1.2 * band[0], band[1] / 1.2, 7):
        wave = sine(wavelength, 10e-6, 30.0)[:, None]
        (smooth,) = filters.zero_phase(wave, (band,), STEP)
        causal = filters.CausalBands((band,), STEP, 1)
        for filtered in (smooth[:, 0], causal.filter(wave)[0, :, 0]):
            level = 20.0 * math.log10(rms(filtered) / (10e-6 / math.sqrt(2.0)))
            assert abs(level) < 0.2, (band, wavelength, middle)


@pytest.mark.parametrize('band', BANDS)
def test_both_filters_have_the_gain_of_their_formula(band):
    wave = np.zeros((200_000, 1))
    wave[100_000] = 1.0
    answer = filters.CausalBands((band,), STEP, 1).filter(wave)[0, 90_000:, 0]
    size = 2**18
    frequency = np.fft.rfftfreq(size, STEP)
    causal = np.abs(np.fft.rfft(np.nan_to_num(answer), size))
    edges = [math.tan(math.pi * STEP / w) for w in band[::-1]]
    warped = np.tan(math.pi * STEP * frequency[1:-1])
    formula = 1.0 / np.sqrt(1.0 + (
        (warped**2 - edges[0] * edges[1]) / (warped * (edges[1] - edges[0])))**8)
    np.testing.assert_allclose(causal[1:-1], formula, rtol=0.0, atol=2e-4)
    np.testing.assert_allclose(
        filters.gain(band, STEP, frequency)[1:-1], formula, rtol=0.0, atol=1e-9)


def test_zero_phase_filter_delays_nothing_and_the_causal_one_as_it_says():
    band = (0.03, 0.1)
    x = np.arange(20_000) * STEP
    burst = np.exp(-(((x - 10.0) / 0.3) ** 2)) * np.sin(2.0 * math.pi * x / math.sqrt(0.003))
    (smooth,) = filters.zero_phase(burst[:, None], (band,), STEP)
    apart = filters.stride(band, STEP)
    np.testing.assert_allclose(
        np.nan_to_num(smooth[:, 0]), burst[::apart], rtol=0.0, atol=0.05)
    causal = np.nan_to_num(filters.CausalBands((band,), STEP, 1).filter(burst[:, None])[0, :, 0])
    centre = float(np.sum(causal**2 * x) / np.sum(causal**2))
    assert centre - 10.0 == pytest.approx(filters.delay(band, STEP) * STEP, abs=0.02)


def test_what_is_not_settled_is_not_valid():
    band = (0.03, 0.1)
    wave = sine(0.05, 1e-5, 6.0)[:, None]
    wave[3000] = np.nan
    settled = filters.settling(band, STEP)
    (smooth,) = filters.zero_phase(wave, (band,), STEP)
    apart = filters.stride(band, STEP)
    x = np.arange(smooth.shape[0]) * apart
    near = (np.abs(x - 3000) <= settled) | (x < settled) | (x > 5999 - settled)
    assert np.array_equal(np.isnan(smooth[:, 0]), near)
    causal = filters.CausalBands((band,), STEP, 1).filter(wave)[0, :, 0]
    assert np.isnan(causal[: settled]).all()
    assert np.isnan(causal[3000 : 3000 + settled]).all()
    assert np.isfinite(causal[settled + 1 : 3000]).all()


# Peak-to-peak and exceedance


@pytest.mark.parametrize('points', [10.3, 20.0, 77.7])
def test_peak_to_peak_of_a_sine_is_twice_its_amplitude(points):
    wavelength = points * STEP
    places, heights = waves.peak_to_peaks(sine(wavelength, 5e-6, 2.0), STEP)
    assert heights == pytest.approx(np.full(heights.size, 10e-6), rel=0.01)
    assert np.diff(places) == pytest.approx(np.full(places.size - 1, 0.5 * wavelength), rel=0.02)


def test_no_peak_to_peak_value_spans_a_gap():
    values = sine(0.05, 5e-6, 1.0)
    values[500:510] = np.nan
    places, _ = waves.peak_to_peaks(values, STEP)
    assert not ((places > 0.49) & (places < 0.52)).any()
    assert places.size > 30


def test_largest_moving_average_is_that_of_the_roughest_window():
    values = np.concatenate((sine(0.05, 2e-6, 5.0), sine(0.05, 6e-6, 1.0), sine(0.05, 2e-6, 4.0)))
    assert waves.largest_mean_peak_to_peak(values, STEP, 1.0) == pytest.approx(12e-6, rel=0.06)
    assert waves.largest_mean_peak_to_peak(values, STEP, 10.0) == pytest.approx(4.8e-6, rel=0.03)


@pytest.mark.parametrize('name', ['grassie_1999', 'en_13231_3_2006', 'en_13231_3_2012'])
def test_share_above_a_limit_is_that_of_the_bad_stretch(name):
    """Three of ten metres are twice the limit, the others half of it."""
    limits = load_limits(name)
    limit = limits.of((0.03, 0.1))
    per_metre = limit.limit * (math.sqrt(2.0) if limits.statistic == 'moving_rms' else 0.5)
    wave = sine(0.05, per_metre, 10.0)
    wave[:7000] *= 0.5
    wave[7000:] *= 2.0
    share, ratio = waves.above(wave, STEP, limits.statistic, limit)
    assert share == pytest.approx(0.3, abs=0.07)
    expected = math.sqrt(0.7 * 0.25 + 0.3 * 4.0) if limits.statistic == 'moving_rms' else 0.95
    assert ratio == pytest.approx(expected, rel=0.01)
    smooth = waves.above(0.2 * wave, STEP, limits.statistic, limit)
    assert smooth[0] == 0.0
    assert smooth[1] == pytest.approx(0.2 * expected, rel=0.01)


def test_nothing_is_above_where_nothing_is_valid():
    limits = load_limits('grassie_1999')
    share, ratio = waves.above(np.full(100, np.nan), STEP, limits.statistic, limits.bands[0])
    assert math.isnan(share)
    assert math.isnan(ratio)


# Impacts


def noise(seed=0, length=10.0, size=1e-6):
    return size * np.random.default_rng(seed).standard_normal(round(length / STEP))


def test_blow_of_a_joint_is_found_where_it_is():
    values = noise()
    x = np.arange(300) * STEP
    values[4000:4300] += 40e-6 * np.exp(-x / 0.05) * np.sin(2.0 * math.pi * x / 0.05)
    assert waves.impacts(values, STEP) == [pytest.approx(4.01, abs=0.03)]


@pytest.mark.parametrize('values', [
    noise(), np.zeros(1000), np.full(1000, np.nan), np.zeros(0),
    noise() + np.where(np.arange(10_000) > 7000, sine(0.05, 30e-6, 10.0), 0.0),
    noise() + sine(0.05, 30e-6, 10.0)])
def test_noise_and_corrugation_are_no_blows(values):
    assert waves.impacts(values, STEP) == []


# Spectra


def test_sine_of_three_micrometres_at_ten_millimetres_reads_six_and_a_half_decibels():
    found = spectrum(sine(0.01, 3e-6, 10.0), STEP)
    assert float(found.levels(0.01)) == pytest.approx(6.53, abs=0.05)
    assert float(found.levels(0.02)) < -40.0


def test_mean_of_spectra_is_the_mean_of_the_powers():
    a, b = (spectrum(sine(0.05, amplitude, length), STEP)
            for amplitude, length in ((2e-6, 10.0), (6e-6, 7.0)))
    together = mean_spectrum([a, b])
    assert math.sqrt(float(together.mean_square(15.0, 25.0))) == pytest.approx(
        math.sqrt((4e-12 + 36e-12) / 4.0), rel=0.01)
