import math

import numpy as np
import pytest

from railtrack_ros.estimation.grid import DistanceGrid
from railtrack_ros.estimation.indicators import (
    BANDS,
    COLUMNS,
    SectionIndicators,
    band_name,
    dominant_wavelength,
)
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.vehicle.description import AxleBox, Contact, Vehicle, Wheel

VEHICLE = Vehicle('test', Wheel(550.0, 100e3, 0.46), Contact(100e9, 1.5),
                  (AxleBox('lead', 'left', 0.0), AxleBox('trail', 'right', -2.5)))


def travel(metres, speed=25.0, rate=25600.0, start=0.0, dvdt=0.0):
    """Times and positions of a run over so many metres."""
    direction = math.copysign(1.0, speed)
    seconds = metres / abs(speed)
    t = np.arange(round(seconds * rate)) / rate
    return t, start + speed * t + 0.5 * direction * dvdt * t * t


def sections(t, position, irregularity, block=256, settings=None, estimator=None):
    """Feed the profile irregularity(x) or arrays by axle box; returns the sections in order."""
    stream = SectionIndicators(VEHICLE, settings or IndicatorSettings(section_length=5.0),
                               estimator)
    if callable(irregularity):
        irregularity = {box.name: irregularity(position + box.offset)
                        for box in VEHICLE.axle_boxes}
    found = []
    for k in range(0, t.size, block):
        part = slice(k, k + block)
        found += stream.feed(t[part], position[part],
                             {name: y[part] for name, y in irregularity.items()})
    found += stream.finish()
    return sorted(found, key=lambda s: (s.axle_box, s.start))


def sine(wavelength, amplitude=10e-6):
    return lambda x: amplitude * np.sin(2.0 * math.pi * x / wavelength)


def whole(found, axle_box='lead'):
    """Sections of one axle box without the ends of the run, where filters settle."""
    return [s for s in found if s.axle_box == axle_box][1:-1]


# The grid in distance


@pytest.mark.parametrize('spacing', [0.02e-3, 0.3e-3, 0.98e-3, 1.0e-3, 3.1e-3, 9.4e-3])
def test_grid_keeps_waves_of_two_and_a_half_samples_or_steps(spacing):
    position = np.arange(0.0, 6.0, spacing)
    for wavelength in (2.5 * max(spacing, 1e-3), 0.03, 0.1):
        k = 2.0 * math.pi / wavelength
        points = DistanceGrid(1e-3, 1).add(position, np.sin(k * position)[:, None])
        inner = slice(200, -200)
        x, y = points.position[inner], points.values[inner, 0]
        assert np.diff(points.position) == pytest.approx(1e-3, abs=1e-9)
        assert np.sqrt(2.0) * np.std(y - np.sin(k * x)) < 0.01


def test_grid_does_not_fold_back_what_is_shorter_than_its_step():
    position = np.arange(0.0, 2.0, 0.05e-3)
    short = np.sin(2.0 * math.pi / 0.7e-3 * position)[:, None]
    points = DistanceGrid(1e-3, 1).add(position, short)
    assert np.nanmax(np.abs(points.values)) < 0.01


def test_grid_does_not_depend_on_the_blocks():
    rng = np.random.default_rng(0)
    position = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 5000))
    position[3000:] += 0.4
    values = rng.standard_normal((5000, 2))
    values[1000, 0] = np.nan
    position[2000:2100] = np.nan
    whole_run = DistanceGrid(1e-3, 2).add(position, values)
    grid = DistanceGrid(1e-3, 2)
    parts = [grid.add(position[k:k + 37], values[k:k + 37]) for k in range(0, 5000, 37)]
    for name in ('values', 'position', 'spacing'):
        joined = np.concatenate([getattr(part, name) for part in parts])
        assert np.array_equal(joined, getattr(whole_run, name), equal_nan=True)


def test_standing_vehicle_makes_no_points_and_takes_no_memory():
    grid = DistanceGrid(1e-3, 1)
    grid.add(np.arange(0.0, 1.0, 1e-3), np.zeros((1000, 1)))
    made = sum(grid.add(np.full(1000, 0.999), np.zeros((1000, 1))).position.size
               for _ in range(20))
    assert made <= 20
    assert grid._distance.size < 2000


def test_correction_of_the_position_moves_the_points_and_not_the_wave():
    position = np.arange(0.0, 4.0, 0.9e-3)
    wave = np.sin(2.0 * math.pi * position / 0.05)
    moved = np.where(position > 2.0, position + 17.3, position)
    points = DistanceGrid(1e-3, 1).add(moved, wave[:, None])
    x = np.where(points.position > 10.0, points.position - 17.3, points.position)
    inner = slice(50, -50)
    assert points.values[inner, 0] == pytest.approx(
        np.sin(2.0 * math.pi * x / 0.05)[inner], abs=0.02 + 2.0 * math.pi / 50.0)
    assert np.count_nonzero(np.diff(points.position) > 10.0) == 1


# Levels


@pytest.mark.parametrize('speed', [5.0, 25.0, 40.0, -25.0])
@pytest.mark.parametrize(('band', 'wavelength'), [
    (0, 0.0125), (0, 0.02), (1, 0.04), (1, 0.08), (2, 0.125), (2, 0.25), (3, 0.4), (3, 0.8)])
def test_band_reads_the_rms_of_a_wave_in_its_middle(speed, band, wavelength):
    found = whole(sections(*travel(26.0, speed), sine(wavelength)))
    assert len(found) >= 3
    for section in found:
        level = 20.0 * math.log10(section.rms[band] / (10e-6 / math.sqrt(2.0)))
        assert abs(level) < 0.2
        assert section.speed == pytest.approx(abs(speed), rel=1e-6)


@pytest.mark.parametrize('band', range(4))
def test_band_is_down_by_3_db_at_its_edges_and_by_24_db_an_octave_outside(band):
    for edge, outside in zip(BANDS[band], (0.5, 2.0), strict=True):
        if edge * outside < 0.006:
            continue
        estimator = EstimatorSettings(cut_on_wavelength=10.0)
        for wavelength, low, high in ((edge, -3.3, -2.7), (edge * outside, -60.0, -22.0)):
            found = whole(sections(*travel(26.0), sine(wavelength), estimator=estimator))
            level = 20.0 * math.log10(found[1].rms[band] * math.sqrt(2.0) / 10e-6)
            assert low < level < high


def test_corrugated_stretch_is_found_where_it_is():
    def profile(x):
        return np.where((x >= 30.0) & (x < 50.0), 10e-6 * np.sin(2 * math.pi * x / 0.045), 0.0)

    for found in (sections(*travel(75.0, dvdt=0.8), profile),
                  sections(*travel(75.0, -25.0, start=75.0), profile)):
        for box in ('lead', 'trail'):
            by_start = {s.start: 1e6 * s.rms[1] for s in found if s.axle_box == box}
            inside = [by_start[start] for start in (30.0, 35.0, 40.0, 45.0)]
            outside = [by_start[start] for start in (15.0, 20.0, 25.0, 50.0, 55.0, 60.0)]
            assert inside == pytest.approx([7.07] * 4, rel=0.03)
            assert max(outside) < 0.3


def test_sections_lie_at_multiples_of_their_length_under_each_axle_box():
    found = sections(*travel(31.0, start=998.0), sine(0.05))
    starts = {name: {s.start for s in found if s.axle_box == name} for name in ('lead', 'trail')}
    # Those of which at least half was run over.
    assert starts == {'lead': set(range(1000, 1026, 5)), 'trail': set(range(995, 1021, 5))}
    assert all(s.end - s.start == 5.0 for s in found)
    assert {(s.axle_box, s.rail) for s in found} == {('lead', 'left'), ('trail', 'right')}


@pytest.mark.parametrize('block', [64, 1000, 100_000])
def test_numbers_do_not_depend_on_the_blocks(block):
    rng = np.random.default_rng(0)
    t, x = travel(40.0)
    y = {box.name: 1e-5 * rng.standard_normal(t.size) for box in VEHICLE.axle_boxes}
    y['lead'][10_000] = np.nan
    rows = [[s.row() for s in sections(t, x, y, size)] for size in (256, block)]
    assert len(rows[0]) == len(rows[1]) > 10
    for a, b in zip(*rows, strict=True):
        for name in COLUMNS:
            assert a[name] == (b[name] if not isinstance(b[name], float)
                               else pytest.approx(b[name], rel=1e-9))


@pytest.mark.parametrize('block', [1, 300, 5000])
def test_run_that_stops_and_turns_back_does_not_depend_on_the_blocks(block):
    """Over a border and back again, twice, with a stand in between."""
    rng = np.random.default_rng(3)
    t = np.arange(60_000) / 6400.0
    speed = 14.0 * np.sin(2.0 * math.pi * t / 4.5)
    speed[(t > 4.0) & (t < 4.6)] = 0.0
    x = 13.0 + np.cumsum(speed) / 6400.0
    y = {box.name: 1e-5 * rng.standard_normal(t.size) for box in VEHICLE.axle_boxes}
    settings = IndicatorSettings(section_length=2.0)
    rows = [[s.row() for s in sections(t, x, y, size, settings)] for size in (256, block)]
    assert len(rows[0]) == len(rows[1]) > 20
    for a, b in zip(*rows, strict=True):
        for name in COLUMNS:
            assert a[name] == (b[name] if not isinstance(b[name], float)
                               else pytest.approx(b[name], rel=1e-9))


def test_no_block_has_to_sum_up_many_sections_and_none_is_kept_longer_than_needed():
    """Eight axle boxes side by side: their sections end together, and come two a block."""
    class Wide:
        axle_boxes = tuple(AxleBox(f'box{n}', 'left', 0.0) for n in range(8))

    t, x = travel(120.0)
    y = {box.name: 1e-5 * np.random.default_rng(n).standard_normal(t.size)
         for n, box in enumerate(Wide.axle_boxes)}
    stream = SectionIndicators(Wide, IndicatorSettings(section_length=5.0))
    came = []
    for k in range(0, t.size, 256):
        part = slice(k, k + 256)
        came.append(len(stream.feed(t[part], x[part], {name: v[part] for name, v in y.items()})))
    assert max(came) == 2
    assert sum(came) == 8 * 23
    assert len(stream.finish()) == 8
    # 5 m of sections, and what lies behind them for the filters.
    assert stream._irregularity._points.shape[1] * 0.002 < 25.0
    assert stream._filters.signals[0]._points.shape[1] * 0.002 < 25.0


def test_single_and_double_precision_give_the_same_numbers():
    t, x = travel(20.0)
    y = {box.name: 1e-5 * np.random.default_rng(1).standard_normal(t.size)
         for box in VEHICLE.axle_boxes}
    single = {name: values.astype(np.float32) for name, values in y.items()}
    assert [s.row() for s in sections(t, x, y)] == [s.row() for s in sections(t, x, single)]


# Validity


@pytest.mark.parametrize(('speed', 'rate', 'cut_on', 'resolved'), [
    (25.0, 25600.0, 3.0, (True, True, True, True)),
    (80.0, 25600.0, 3.0, (False, True, True, True)),   # 8 kHz at 10 mm: beyond the track model
    (18.9, 2000.0, 3.0, (False, True, True, True)),    # 9.4 mm a sample
    (26.0, 2560.0, 3.0, (False, False, True, True)),   # 30 mm are less than three samples
    (25.0, 2000.0, 3.0, (False, False, True, True)),
    (25.0, 25600.0, 1.0, (True, True, True, False)),
])
def test_band_that_cannot_be_resolved_is_empty(speed, rate, cut_on, resolved):
    rng = np.random.default_rng(0)
    t, x = travel(26.0, speed, rate)
    y = {box.name: 1e-5 * rng.standard_normal(t.size) for box in VEHICLE.axle_boxes}
    found = whole(sections(t, x, y, estimator=EstimatorSettings(cut_on_wavelength=cut_on)))
    for section in found:
        assert tuple(math.isfinite(rms) for rms in section.rms) == resolved
        row = section.row()
        assert tuple(row[f'rms_{band_name(band)}_um'] is not None for band in BANDS) == resolved


def test_samples_that_are_not_valid_are_left_out():
    t, x = travel(41.0)
    y = {box.name: sine(0.045)(x + box.offset) for box in VEHICLE.axle_boxes}
    y['lead'][(x > 11.0) & (x < 13.0)] = np.nan
    y['lead'][(x > 20.0) & (x < 24.0)] = np.nan
    found = {s.start: s for s in sections(t, x, y) if s.axle_box == 'lead'}
    assert found[10.0].rms[1] == pytest.approx(7.07e-6, rel=0.03)
    assert found[10.0].valid_fraction == pytest.approx(0.6, abs=0.02)
    assert found[10.0].dominant_wavelength == pytest.approx(0.045, rel=0.03)
    assert 20.0 not in found
    assert found[30.0].valid_fraction == 1.0


def test_run_without_positions_gives_nothing():
    t, x = travel(20.0)
    assert sections(t, np.full(x.size, np.nan), {'lead': np.zeros(x.size)}) == []


def test_axle_box_that_is_missing_gives_nothing_and_the_other_everything():
    t, x = travel(20.0)
    found = sections(t, x, {'trail': sine(0.05)(x)})
    assert {s.axle_box for s in found} == {'trail'}


# Dominant wavelength


@pytest.mark.parametrize('wavelength', [0.012, 0.025, 0.045, 0.08, 0.15, 0.24, 0.5])
@pytest.mark.parametrize('length', [5.0, 10.0])
def test_wave_over_rough_rail_is_named(wavelength, length):
    rough = iso3095(60.0, 0.001, 4, 0.0)
    settings = IndicatorSettings(section_length=length)
    strength = 10e-6 * (wavelength / 0.045)

    def profile(x):
        return rough.at(x) + sine(wavelength, strength)(x)

    found = whole(sections(*travel(55.0, start=3.0), profile, settings=settings))
    for section in found:
        assert section.dominant_wavelength == pytest.approx(wavelength, rel=0.03)
        assert section.dominant_rms == pytest.approx(strength / math.sqrt(2.0), rel=0.3)
        assert section.dominant_above_limit > 10.0


def test_rise_towards_an_end_of_the_range_is_no_wave():
    """A wave of 1.4 m, above what can be resolved, is not named as one of 1 m."""
    x = np.arange(0.0, 10.0, 0.001)
    y = iso3095(20.0, 0.001, 4, 0.0).at(x) + sine(1.4, 200e-6)(x)
    assert math.isnan(dominant_wavelength(y, 0.001, 0.01, 1.0, 9.0)[0])
    named = dominant_wavelength(y + sine(0.05, 15e-6)(x), 0.001, 0.01, 1.0, 9.0)[0]
    assert named == pytest.approx(0.05, rel=0.01)


def test_rough_rail_alone_names_nothing():
    named = 0
    for seed in range(3):
        rough = iso3095(200.0, 0.001, seed, 0.0)
        stretches = rough.at(np.arange(0.0, 200.0, 0.001)).reshape(-1, 5000)
        named += sum(math.isfinite(dominant_wavelength(y, 0.001, 0.01, 1.0, 9.0)[0])
                     for y in stretches)
    assert named <= 2  # of 120 sections


def test_level_above_the_limit_is_that_of_the_rail():
    # A rail 6 dB above the limit everywhere is 6 dB above the limit at its peak, give or take
    # the randomness of the peak over 200 m.
    rough = iso3095(200.0, 0.001, 9, 0.0)
    y = 2.0 * rough.at(np.arange(0.0, 200.0, 0.001))
    _, _, level = dominant_wavelength(y, 0.001, 0.01, 0.3)
    assert 6.0 < level < 8.5


@pytest.mark.parametrize('y', [np.zeros(5000), np.full(5000, np.nan), np.zeros(0), np.ones(3)])
def test_nothing_stands_out_of_nothing(y):
    assert all(math.isnan(value) for value in dominant_wavelength(y, 0.001, 0.01, 1.0))
