"""Axle boxes fused per rail, blocks, exclusion of impacts, stretches to grind, whole analyses."""

import math

import numpy as np
import pytest

from railtrack_ros.estimation.analysis import TrackAnalysis
from railtrack_ros.estimation.bands import gain
from railtrack_ros.estimation.indicators import BANDS, SectionIndicators
from railtrack_ros.estimation.rails import blocks, describe, length_of, row, stretches
from railtrack_ros.estimation.section import ERROR, OK, WARN
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.irregularity.profile import corrugation, iso3095
from railtrack_ros.vehicle.description import AxleBox

SPEED, RATE = 25.0, 12800.0


class Coach:
    axle_boxes = (AxleBox('one', 'left', 0.0), AxleBox('two', 'left', -2.5),
                  AxleBox('three', 'left', -19.0))


class Single:
    axle_boxes = (AxleBox('one', 'left', 0.0),)


def analyse(profile, metres=120.0, vehicle=Coach, settings=None, start=0.0, radius=None,
            wheel=None, speed=SPEED, block=640):
    """Run over a profile of the rail; wheel(box, distance run) is added. Also the live sections."""
    t = np.arange(round(metres / abs(speed) * RATE)) / RATE
    position = start + speed * t
    settings = settings or IndicatorSettings()
    analysis = TrackAnalysis(vehicle, settings, EstimatorSettings(), wheel_radius=radius)
    live, sections = SectionIndicators(vehicle, settings), []
    data = {box.name: profile(position + box.offset) for box in vehicle.axle_boxes}
    if wheel is not None:
        for box in vehicle.axle_boxes:
            data[box.name] = data[box.name] + wheel(box.name, abs(speed) * t)
    for k in range(0, t.size, block):
        part = slice(k, k + block)
        given = {name: y[part] for name, y in data.items()}
        analysis.feed(t[part], position[part], given)
        sections += live.feed(t[part], position[part], given)
    return analysis.finish(), sections + live.finish(), analysis.judge


def corrugated(begin, end, amplitude=15e-6, wavelength=0.05, roughness=0.3):
    rough = iso3095(600.0, 1e-3, 7, -100.0)

    def profile(x):
        if begin == end:
            return roughness * rough.at(x)
        return roughness * rough.at(x) + corrugation(x, wavelength, amplitude, begin, end)
    return profile


@pytest.fixture(scope='module')
def run():
    return analyse(corrugated(50.0, 80.0))


def test_corrugated_sections_are_errors_and_the_others_are_not(run):
    found, _, _ = run
    level = {section.start: section.level for section in found.rails}
    assert {start for start, value in level.items() if value == ERROR} == {50.0, 60.0, 70.0}
    assert level[20.0] == OK
    for section in found.rails:
        if 50.0 <= section.start < 80.0:
            assert section.axle_boxes == 3
            assert section.dominant_wavelength == pytest.approx(0.05, rel=0.03)
            assert section.depth == pytest.approx(30e-6, rel=0.05)
            assert section.rms[1] == pytest.approx(15e-6 / math.sqrt(2.0), rel=0.03)
            assert section.spread[1] < 0.2
            assert 'Grassie' in section.reason


def test_live_and_zero_phase_agree_within_what_the_documentation_states(run):
    """0.5 dB in every section with all of it valid, 0.1 dB in the median."""
    found, live, _ = run
    other = {(s.axle_box, s.start): s for s in found.combined}
    differences = []
    for section in live:
        twin = other.get((section.axle_box, section.start))
        if twin is None or min(section.valid_fraction, twin.valid_fraction) < 1.0:
            continue
        assert section.level == twin.level
        differences += [20.0 * math.log10(a / b) for a, b in zip(section.rms, twin.rms, strict=True)
                        if math.isfinite(a) and math.isfinite(b)]
    assert len(differences) > 60
    assert np.median(np.abs(differences)) < 0.1
    assert np.max(np.abs(differences)) < 0.5


def test_reaches_join_without_a_seam():
    """A run longer than a reach gives every section once, as a run inside one does."""
    profile = corrugated(395.0, 405.0)
    long, _, _ = analyse(profile, 460.0, Single)
    short, _, _ = analyse(profile, 100.0, Single, start=360.0)
    assert [s.start for s in long.rails] == list(np.arange(0.0, 460.0, 10.0))
    one = {s.start: s.rms for s in long.rails}
    for section in short.rails[1:-1]:
        for a, b in zip(section.rms[:3], one[section.start][:3], strict=True):
            assert a == pytest.approx(b, rel=0.01)


def test_one_bad_wheel_does_not_move_three():
    def flat(name, s):
        return 25e-6 * np.sin(2.0 * math.pi * s / 0.06) if name == 'two' else 0.0 * s
    found, _, _ = analyse(corrugated(0.0, 0.0), wheel=flat)
    middle = [s for s in found.rails if 20.0 <= s.start < 90.0]
    clean, _, _ = analyse(corrugated(0.0, 0.0))
    for section, other in zip(middle, [s for s in clean.rails if 20.0 <= s.start < 90.0],
                              strict=True):
        assert section.rms[1] == pytest.approx(other.rms[1], rel=0.15)
        assert section.spread[1] > 5.0


def test_polygon_is_taken_off_the_rail_and_named():
    def polygon(name, s):
        radius = {'one': 0.458, 'two': 0.4595, 'three': 0.461}[name]
        return sum(12e-6 * np.cos(n * s / radius + n) for n in (3, 8, 13, 17, 20))
    profile = corrugated(200.0, 230.0)
    found, _, _ = analyse(profile, 420.0, wheel=polygon, radius=0.46)
    clean, _, _ = analyse(profile, 420.0)
    assert {w.axle_box for w in found.wheels} == {'one', 'two', 'three'}
    for wheel in found.wheels:
        worst = sorted(np.argsort(-wheel.amplitude)[:5] + 1)
        assert worst == [3, 8, 13, 17, 20]
        assert 20.0 * np.log10(wheel.amplitude[[2, 7, 12, 16, 19]] / 12e-6) == pytest.approx(
            np.zeros(5), abs=1.0)
    combined = np.median([s.rms[2] for s in found.combined])
    before, after = (np.median([s.rms[2] for s in x.rails]) for x in (clean, found))
    assert combined > 4.0 * before
    assert after == pytest.approx(before, rel=0.1)


def test_section_over_a_joint_is_excluded_from_the_block():
    def profile(x):
        dip = np.where(np.abs(x - 63.0) < 0.1, -150e-6 * (1.0 - np.abs(x - 63.0) / 0.1), 0.0)
        return corrugated(0.0, 0.0)(x) + dip
    found, _, judge = analyse(profile)
    excluded = [s.start for s in found.rails if s.excluded]
    assert excluded == [60.0]
    (block,) = (b for b in blocks(found.rails, 50.0, judge) if b.start == 50.0)
    assert (block.sections, block.excluded_sections) == (5, 1)
    clean, _, _ = analyse(corrugated(0.0, 0.0))
    (without,) = (b for b in blocks(clean.rails, 50.0, judge) if b.start == 50.0)
    assert block.rms[1] == pytest.approx(without.rms[1], rel=0.1)
    assert row(block)['excluded_sections'] == 1
    assert stretches(found.rails, judge) == []


@pytest.mark.parametrize(('at', 'struck'), [
    (59.5, [50.0]), (59.9, [50.0, 60.0]), (60.0, [50.0, 60.0]), (60.1, [50.0, 60.0]),
    (60.5, [60.0])])
def test_joint_beside_a_border_excludes_the_sections_on_either_side(at, struck):
    """Live and in the analysis: its longer waves are in both."""
    def profile(x):
        dip = np.where(np.abs(x - at) < 0.1, -150e-6 * (1.0 - np.abs(x - at) / 0.1), 0.0)
        return corrugated(0.0, 0.0)(x) + dip
    found, live, _ = analyse(profile, vehicle=Single)
    assert [s.start for s in found.rails if s.excluded] == struck
    assert [s.start for s in live if s.impacts] == struck


def test_corrugation_that_begins_at_a_border_excludes_nothing():
    found, live, _ = analyse(corrugated(60.0, 80.0), vehicle=Single)
    assert not [s.start for s in found.rails if s.excluded]
    assert not [s.start for s in live if s.impacts]


def test_blow_that_one_wheel_alone_gives_excludes_nothing():
    def flat(name, s):
        return np.where(np.abs(s - 63.0) < 0.05, 80e-6, 0.0) if name == 'one' else 0.0 * s
    found, _, _ = analyse(corrugated(0.0, 0.0), wheel=flat)
    (section,) = (s for s in found.rails if s.start == 60.0)
    assert not section.excluded
    assert section.axle_boxes == 2
    assert section.impacts > 0


def test_stretches_are_merged_and_ranked():
    first, second = corrugated(30.0, 40.0), corrugated(50.0, 60.0, roughness=0.0)
    third = corrugated(95.0, 105.0, 40e-6, roughness=0.0)
    found, _, judge = analyse(lambda x: first(x) + second(x) + third(x), 140.0)
    merged = stretches(found.rails, judge, 20.0)
    assert [(s.start, s.end) for s in merged] == [(90.0, 110.0), (30.0, 60.0)]
    assert merged[1].share == pytest.approx(2.0 / 3.0)
    assert merged[0].ratio > merged[1].ratio > 1.0
    assert merged[0].wave[0] == pytest.approx(0.05, rel=0.03)
    assert describe(merged[0]).startswith('left rail, 90 to 110 m, 30-100 mm: ')
    apart = stretches(found.rails, judge, 5.0)
    assert [(s.start, s.end) for s in apart] == [(90.0, 110.0), (30.0, 40.0), (50.0, 60.0)]


def test_each_band_has_its_own_stretches_and_their_union_is_ground():
    short, long = corrugated(50.0, 70.0), corrugated(20.0, 90.0, 20e-6, 0.2, 0.0)
    found, _, judge = analyse(lambda x: short(x) + long(x))
    both = stretches(found.rails, judge)
    assert {(s.band, s.start, s.end) for s in both} == {(1, 50.0, 70.0), (2, 20.0, 90.0)}
    assert length_of(both) == 70.0


def test_warning_is_more_than_the_allowed_share_above_the_limit():
    found, live, _ = analyse(corrugated(62.0, 64.0, 15e-6))
    (section,) = (s for s in found.rails if s.start == 60.0)
    assert section.level == WARN
    assert 0.05 < section.above[1] < 0.4
    assert section.ratio[1] < 1.0
    assert '% above the limit' in section.reason
    assert {s.level for s in live if s.start == 60.0} == {WARN}


def test_levels_stop_where_the_speed_resolves_no_more():
    centres = 10.0 ** (-np.arange(0, 21) / 10.0)
    found, _, _ = analyse(corrugated(0.0, 0.0), vehicle=Single, speed=80.0, metres=200.0)
    section = found.rails[5]  # 80 m/s at 12.8 kHz: five samples are 31 mm
    levels = section.levels(centres)
    assert np.isnan(levels[centres < 0.031]).all()
    assert np.isfinite(levels[(centres > 0.037) & (centres <= 1.0)]).all()
    assert math.isnan(section.rms[0])


def test_run_backwards_finds_the_same_places():
    found, _, _ = analyse(corrugated(50.0, 80.0), start=120.0, speed=-25.0)
    assert {s.start for s in found.rails if s.level == ERROR} == {50.0, 60.0, 70.0}
    assert [s.start for s in found.rails] == sorted(s.start for s in found.rails)


def test_other_bands_and_limits_are_used():
    settings = IndicatorSettings(bands='20-80,80-400', limits='en_13231_3_2012')
    found, _, _ = analyse(corrugated(50.0, 80.0), vehicle=Single, settings=settings)
    (section,) = (s for s in found.rails if s.start == 60.0)
    assert len(section.rms) == 2
    assert section.rms[0] == pytest.approx(15e-6 / math.sqrt(2.0), rel=0.05)
    assert all(map(math.isnan, section.above))  # the set has no limit for these bands
    assert 'rms_20_80_um' in row(section)


# Waveforms


def waveforms(profile, metres=120.0, vehicle=Coach, settings=None, position=None, gap=None,
              rate=RATE):
    """Positions (n,) and waveforms by rail (bands, n) of a run over a profile, stretches joined."""
    t = np.arange(round(metres / SPEED * rate)) / rate
    place = SPEED * t if position is None else position(t)
    found = []
    analysis = TrackAnalysis(vehicle, settings or IndicatorSettings(), EstimatorSettings(),
                             waveforms=found.append)
    for k in range(0, t.size, 640):
        part = slice(k, k + 640)
        given = {box.name: profile(place[part] + box.offset) for box in vehicle.axle_boxes}
        if gap is not None and gap[0] <= t[k] < gap[1]:
            given = {}
        analysis.feed(t[part], place[part], given)
    analysis.finish()
    return (np.concatenate([item.position for item in found]),
            {rail: np.concatenate([item.rails[rail] for item in found], axis=1)
             for rail in found[0].rails})


WAVES = np.array((0.018, 0.055, 0.17, 0.55))


def waves_of(x, gains=(1.0, 1.0, 1.0, 1.0)):
    return sum(1e-5 * gain * np.sin(2.0 * math.pi * x / wave + wave)
               for wave, gain in zip(WAVES, gains, strict=True))


@pytest.mark.parametrize('metres', [60.0, 1000.0])
def test_waveforms_are_those_of_the_rail_place_by_place(metres):
    """One reach or several: each place once, and every wave with its own phase."""
    x, rails = waveforms(waves_of, metres)
    assert np.diff(x) == pytest.approx(np.full(x.size - 1, 0.002), abs=1e-9)
    for band, ends in enumerate(BANDS):
        found = rails['left'][band]
        good = np.isfinite(found)
        assert good[(x > 2.0) & (x < metres - 3.0)].all()
        truth = waves_of(x, gain(ends, 0.002, 1.0 / WAVES))
        assert np.abs(found - truth)[good & (x > 2.0) & (x < metres - 22.0)].max() < 1e-7


def test_waveforms_of_a_run_that_turns_back_say_the_same_both_ways():
    x, rails = waveforms(waves_of, 200.0, position=lambda t: 60.0 - np.abs(SPEED * t - 60.0))
    back = np.flatnonzero(np.diff(x) < 0.0)
    assert x[0] == pytest.approx(-19.0, abs=0.01)
    assert x.max() == pytest.approx(60.0, abs=0.01)
    assert np.diff(back).max() == 1  # once, and then on
    there, again = (slice(0, back[0]), slice(back[0] + 1, None))
    for band in range(3):
        found = rails['left'][band]
        inside = (x > 5.0) & (x < 30.0) & np.isfinite(found)
        one = dict(zip(np.round(x[there] * 500).astype(int), found[there], strict=True))
        pairs = [(value, one[key]) for key, value, good in zip(
            np.round(x[again] * 500).astype(int), found[again], inside[again], strict=True)
            if good and key in one]
        assert len(pairs) > 10_000
        a, b = np.array(pairs).T
        assert np.abs(a - b).max() < 5e-7


def test_waveform_is_empty_where_a_band_is_not_resolved_or_nothing_is_valid():
    x, rails = waveforms(waves_of, 120.0, rate=2000.0)  # 12.5 mm a sample
    assert np.isnan(rails['left'][:2]).all()
    assert np.isfinite(rails['left'][2][(x > 5.0) & (x < 90.0)]).all()
    x, rails = waveforms(waves_of, 120.0, Single, gap=(2.0, 2.4))
    inside = (x > 51.0) & (x < 59.0)
    assert np.isnan(rails['left'][:, inside]).all()
    assert np.isfinite(rails['left'][0][(x > 5.0) & (x < 48.0)]).all()
