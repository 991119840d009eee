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


def causal(values, band):
    """What the causal filter makes of values (1, n)."""
    stream = filters.CausalBands((band,), STEP, 1)
    stream.add(values.astype(np.float32))
    return stream.signals[0].part(0, values.size)[0].astype(float)


def amplitude(values, wavelength, band):
    """Amplitude of the wave in what a filter has made of it, where it has settled."""
    good = np.flatnonzero(np.isfinite(values))
    phase = 2.0 * math.pi * good * filters.stride(band, STEP) * STEP / wavelength
    waves = np.stack((np.cos(phase), np.sin(phase)), axis=1)
    return float(np.hypot(*np.linalg.lstsq(waves, values[good], rcond=None)[0]))


@pytest.mark.parametrize('band', BANDS)
def test_filters_are_within_a_fifth_of_a_decibel_in_their_pass_band(band):
    """The pass-band of a Butterworth filter is where it is flat: 0.68 of its width in Q."""
    middle = math.sqrt(band[0] * band[1])
    for wavelength in np.geomspace(1.2 * band[0], band[1] / 1.2, 7):
        wave = sine(wavelength, 10e-6, 90.0)[None]
        (smooth,) = filters.zero_phase(wave, (band,), STEP)
        for filtered in (smooth[0], causal(wave, band)):
            level = 20.0 * math.log10(amplitude(filtered, wavelength, band) / 10e-6)
            assert abs(level) < 0.2, (band, wavelength, middle)


@pytest.mark.parametrize('band', BANDS)
def test_both_filters_have_the_gain_of_their_formula(band):
    """Up to the band's shortest wave, where the thinning of the points ends to be flat."""
    apart = filters.stride(band, STEP)
    assert apart in (1, 3, 9, 27)
    assert band[0] >= 10 * apart * STEP * (1.0 - 1e-9)
    wave = np.zeros((1, 27 * 20_000))
    wave[0, 27 * 10_000] = apart  # height of a thinned impulse of one
    answer = np.nan_to_num(causal(wave, band))[9_000 * 27 // apart :]
    size = 2**20
    frequency = np.fft.rfftfreq(size, STEP * apart)
    frequency, response = frequency[1:], np.abs(np.fft.rfft(answer, size))[1:]
    edges = [math.tan(math.pi * STEP * apart / w) for w in band[::-1]]
    warped = np.tan(math.pi * STEP * apart * np.minimum(frequency, 0.4999 / STEP / apart))
    formula = 1.0 / np.sqrt(1.0 + (
        (warped**2 - edges[0] * edges[1]) / (warped * (edges[1] - edges[0])))**8)
    inside = frequency <= 1.0 / band[0]
    np.testing.assert_allclose(response[inside], formula[inside], rtol=0.0,
                               atol=2e-4 if apart == 1 else 2e-3)
    gain = filters.gain(band, STEP, frequency[:-1])
    np.testing.assert_allclose(gain, formula[:-1], rtol=0.0, atol=1e-9)


def test_nothing_folds_back_into_a_band_when_points_are_thinned_out():
    """Waves shorter than the band, two to a dozen points each, leave no more than 0.03 %."""
    for band in BANDS[1:]:
        for wavelength in np.geomspace(0.0021, 0.35 * band[0], 40):
            wave = sine(wavelength, 1.0, 40.0)[None]
            assert np.nanmax(np.abs(causal(wave, band)[-200:])) < 2e-2
            apart = filters.stride(band, STEP) * STEP
            image = abs(1.0 / wavelength - round(apart / wavelength) / apart)
            if 1.0 / band[1] <= image <= 1.0 / band[0]:
                assert np.nanmax(np.abs(causal(wave, band)[-200:])) < 5e-4


def test_zero_phase_filter_delays_nothing_and_the_causal_one_as_it_says():
    for band in BANDS:
        middle = math.sqrt(band[0] * band[1])
        apart = filters.stride(band, STEP)
        x = np.arange(60_000) * STEP
        burst = np.exp(-(((x - 30.0) / (5.0 * middle)) ** 2)) * np.sin(2.0 * math.pi * x / middle)
        (smooth,) = filters.zero_phase(burst[None], (band,), STEP)
        np.testing.assert_allclose(
            np.nan_to_num(smooth[0]), burst[::apart], rtol=0.0, atol=0.05)
        answer = np.nan_to_num(causal(burst[None], band))
        centre = float(np.sum(answer**2 * x[::apart][: answer.size]) / np.sum(answer**2))
        assert centre - 30.0 == pytest.approx(filters.delay(band, STEP) * STEP, rel=0.1)


def test_what_is_not_settled_is_not_valid():
    band = (0.03, 0.1)
    wave = sine(0.05, 1e-5, 6.0)[None]
    wave[0, 3000] = np.nan
    settled = filters.settling(band, STEP)
    (smooth,) = filters.zero_phase(wave, (band,), STEP)
    apart = filters.stride(band, STEP)
    x = np.arange(smooth.shape[1]) * apart
    near = (np.abs(x - 3000) <= settled) | (x < settled) | (x > 5999 - settled)
    assert np.array_equal(np.isnan(smooth[0]), near)
    answer = causal(wave, band)
    x = np.arange(answer.size) * apart
    reach = filters.HALF_THIRD
    assert np.isnan(answer[x < settled]).all()
    assert np.isnan(answer[(x >= 3000 - reach) & (x < 3000 + settled)]).all()
    assert np.isfinite(answer[(x > settled + 2 * apart + reach) & (x < 3000 - reach)]).all()
    assert np.isfinite(answer[x > 3000 + settled + reach + 2 * apart]).all()


@pytest.mark.parametrize('block', [1, 7, 1000])
def test_causal_filters_do_not_depend_on_the_blocks(block):
    values = np.random.default_rng(0).standard_normal((2, 4000)).astype(np.float32)
    values[0, 1500] = np.nan
    whole, parts = (filters.CausalBands(BANDS, 2 * STEP, 2) for _ in range(2))
    whole.add(values)
    for k in range(0, values.shape[1], block):
        parts.add(values[:, k : k + block])
    for one, other in zip(whole.signals, parts.signals, strict=True):
        assert one.end == other.end
        assert np.array_equal(one.part(0, one.end), other.part(0, one.end), equal_nan=True)


# Peak-to-peak and exceedance


@pytest.mark.parametrize(('points', 'bound'), [
    (5.1, 0.02), (6.7, 0.01), (10.3, 0.01), (20.0, 0.01), (77.7, 0.01)])
def test_peak_to_peak_of_a_sine_is_twice_its_amplitude(points, bound):
    wavelength = points * STEP
    places, heights = waves.peak_to_peaks(sine(wavelength, 5e-6, 2.0), STEP)
    inner = heights if points > 10.0 else heights[5:-5]  # too few points at the ends
    assert inner == pytest.approx(np.full(inner.size, 10e-6), rel=bound)
    assert np.mean(heights) == pytest.approx(10e-6, rel=0.01)
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


def blow(at, length=10.0):
    values = noise(1, length)
    x = np.arange(300) * STEP
    values[round(at / STEP) : round(at / STEP) + 300] += (
        40e-6 * np.exp(-x / 0.05) * np.sin(2.0 * math.pi * x / 0.05))
    return values


AROUND = round(waves.IMPACT_AROUND / STEP)


def blows_of_two_sections(values):
    """Places of the blows as two sections of 5 m find them, each with what is around it."""
    first = waves.impacts(values[:5000], STEP, values[:0], values[5000 : 5000 + AROUND])
    second = waves.impacts(values[5000:], STEP, values[5000 - AROUND : 5000], values[:0])
    return first, [5.0 + x for x in second]


@pytest.mark.parametrize('at', [0.01, 4.0, 4.6, 4.95, 4.98, 5.0, 5.01, 5.05, 5.4, 9.6])
def test_blow_beside_a_border_is_one_of_the_sections_on_either_side(at):
    first, second = blows_of_two_sections(blow(at))
    place = [pytest.approx(at + 0.012, abs=0.03)]
    assert first == (place if at < 5.2 else [])
    assert second == (place if at > 4.8 else [])


@pytest.mark.parametrize('begin', [4980, 5000, 5100, 5250, 5400])
def test_corrugation_that_begins_at_a_border_is_no_blow_of_the_section_before(begin):
    values = noise(2) + np.where(np.arange(10_000) > begin, sine(0.05, 30e-6, 10.0), 0.0)
    assert blows_of_two_sections(values) == ([], [])
    values[1000:1010] += 50e-6  # but a blow elsewhere in it is one
    assert len(blows_of_two_sections(values)[0]) == 1


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
