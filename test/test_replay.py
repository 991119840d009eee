"""The full model over a recording: what drives it, how it is compared, what it leaves on disk."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.codec import SECOND, WaveformBlock
from railtrack_ros.bags.reader import AccelerationBlock, read_run, read_waveform
from railtrack_ros.bags.writer import Recording
from railtrack_ros.cli.main import main
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.report.content import Indicators
from railtrack_ros.runs import comparison, replay_files
from railtrack_ros.runs.comparison import band_for
from railtrack_ros.runs.driven import drive, oversampling
from railtrack_ros.runs.replay import estimate_run, replay_recording
from railtrack_ros.runs.replay_input import Bound, Stretch
from railtrack_ros.runs.replay_model import Samples, _excitation, _high_pass, _place, replay
from railtrack_ros.runs.replay_report import About, overall, replay_report, unexplained, worst
from railtrack_ros.runs.synthesize import synthesize
from railtrack_ros.runs.virtual_run import RunSettings
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import Stretch as TrackStretch
from railtrack_ros.vehicle.description import load_vehicle

RATE = 25600.0
STEP = 1.0 / RATE
SETTINGS = EstimatorSettings()
MESH = Mesh(elements_per_bay=6)


@pytest.fixture(scope='module')
def bogie():
    """Return a vehicle of two wheels on one rail."""
    coach = load_vehicle('measurement_coach')
    return dataclasses.replace(coach, name='bogie', axle_boxes=coach.on_rail('left')[:2])


@pytest.fixture(scope='module')
def recording(table_3_1, bogie, tmp_path_factory):
    """Return an accelerating run of 2 s with its truth."""
    path = tmp_path_factory.mktemp('run') / 'run.mcap'
    settings = RunSettings(duration=2.0, speed=24.0, acceleration=2.0, roughness='iso3095',
                           noise=0.1, start_position=100.0, seed=3)
    synthesize(table_3_1, bogie, settings, path)
    return path


@pytest.fixture(scope='module')
def replayed(recording, table_3_1, bogie, tmp_path_factory):
    output = tmp_path_factory.mktemp('replayed') / 'out'
    result = replay_recording(recording, table_3_1, bogie, output,
                              Stretch(Bound(125.0, 'm'), Bound(1.6, 's')))
    return output, result


def whole_run(path, *arguments):
    """Run the estimator over a recording; return what it found with the samples of all of it."""
    taken = []
    found = estimate_run(path, *arguments, Stretch(), lambda *args: taken.append(args))
    found.samples = taken[0][0]
    return found


def sine(speed, wavelength, seconds=2.0):
    x = speed * STEP * np.arange(round(seconds * RATE))
    return x, 10e-6 * np.sin(2 * np.pi * x / wavelength)


# What is compared, and how


def test_identical_signals_are_0_db_apart():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(40000)
    band = band_for(25.0, 3.0, STEP)
    lines = comparison.errors('contact_force', 'a', ('x', noise), ('y', noise.copy()),
                              25.0 * STEP * np.arange(noise.size), band)
    assert {e.band for e in lines} == {'all', 'frequency', 'wavelength'}
    assert all(e.level_difference == 0.0 for e in lines)
    assert all(e.rms_difference == 0.0 for e in lines)


def test_a_signal_of_twice_the_amplitude_is_6_db_higher_in_every_band():
    noise = np.random.default_rng(0).standard_normal(40000)
    lines = comparison.errors('contact_force', 'a', ('x', 2 * noise), ('y', noise),
                              25.0 * STEP * np.arange(noise.size), band_for(25.0, 3.0, STEP))
    assert [e.level_difference for e in lines] == pytest.approx([6.0206] * len(lines), abs=1e-3)


def test_signals_out_of_phase_differ_although_their_levels_agree():
    t = STEP * np.arange(40000)
    a, b = np.sin(2 * np.pi * 400 * t), np.cos(2 * np.pi * 400 * t)
    lines = comparison.errors('contact_force', 'a', ('x', a), ('y', b), 25.0 * t,
                              band_for(25.0, 3.0, STEP))
    at_400 = next(e for e in lines if e.band == 'frequency' and 390 < e.frequency < 410)
    assert abs(at_400.level_difference) < 0.01
    assert at_400.difference_level == pytest.approx(3.01, abs=0.05)


def test_bands_of_wavelength_follow_the_distance_and_not_the_time():
    """A corrugation of 50 mm stays in its band while the speed doubles."""
    t = STEP * np.arange(60000)
    speed = 15.0 + 6.0 * t
    x = np.cumsum(speed) * STEP
    signal = np.sin(2 * np.pi * x / 0.05)
    lines = comparison.errors('irregularity', 'a', ('x', signal), ('y', signal), x,
                              band_for(float(speed.max()), 3.0, STEP))
    levels = {e.wavelength: e.rms_compared for e in lines if e.band == 'wavelength'}
    peak = max(levels, key=levels.get)
    assert peak == pytest.approx(0.0501, rel=1e-2)
    assert levels[peak] == pytest.approx(np.sqrt(0.5), rel=0.03)


def test_the_band_keeps_dynamics_and_drops_the_static_load_and_the_edges():
    band = band_for(25.0, 3.0, STEP)
    t = STEP * np.arange(40000)
    limited = band.limit(1e5 + 1e3 * np.sin(2 * np.pi * 300 * t))
    inner = limited[np.isfinite(limited)]
    assert inner.size == t.size - 2 * band.edge
    assert np.abs(inner).max() == pytest.approx(1e3, rel=5e-3)
    assert np.abs(band.limit(np.full(40000, 1e5))[band.edge:-band.edge]).max() < 1e-6


def test_the_low_pass_keeps_the_static_part_and_gaps():
    band = band_for(25.0, 3.0, STEP)
    values = np.full(20000, 1e5)
    values[9000:9100] = np.nan
    low = band.low_pass(values)
    assert np.isnan(low[9000:9100]).all()
    assert np.delete(low, np.s_[9000:9100]) == pytest.approx(1e5, rel=1e-12)


@pytest.mark.parametrize(('speed', 'low'), [(10.0, 20.0), (60.0, 40.0)])
def test_the_band_begins_above_the_cut_on_of_the_irregularity(speed, low):
    assert band_for(speed, 3.0, STEP).low == pytest.approx(low)


def test_a_sample_rate_that_leaves_no_band_is_refused():
    with pytest.raises(InputError, match='no frequency to compare'):
        band_for(60.0, 3.0, 1 / 100.0)


# What drives the model


def test_the_excitation_has_the_phase_of_the_irregularity_that_was_high_passed():
    speed = np.full(round(2.0 * RATE), 25.0)
    x, irregularity = sine(25.0, 0.3)
    causal = _high_pass(irregularity, speed, STEP, SETTINGS)
    excitation, settled = _excitation(causal, speed, STEP, SETTINGS)
    wave = np.exp(2j * np.pi * x / 0.3)
    shift = np.angle(np.sum(excitation[settled] * wave[settled].conj())
                     / np.sum(irregularity[settled] * wave[settled].conj()), deg=True)
    there = np.isfinite(causal)
    before = np.angle(np.sum(causal[there] * wave[there].conj())
                      / np.sum(irregularity[there] * wave[there].conj()), deg=True)
    assert abs(before) > 14.0          # what driving the model with the causal one would cost
    assert abs(shift) < 0.1
    assert excitation[settled] == pytest.approx(irregularity[settled], abs=2e-8)
    assert excitation[0] == 0.0


def test_an_interrupted_channel_fades_out_and_settles_again():
    speed = np.full(round(4.0 * RATE), 25.0)
    _, irregularity = sine(25.0, 0.1, seconds=4.0)
    irregularity[51000:51300] = np.nan
    excitation, settled = _excitation(irregularity, speed, STEP, SETTINGS)
    assert np.isfinite(excitation).all()
    assert np.abs(np.diff(excitation)).max() < 1.2 * 2 * np.pi * 10e-6 * 25.0 * STEP / 0.1
    assert not settled[51000:51300 + round(0.5 * RATE)].any()
    assert len(list(comparison.pieces(settled))) == 2


def test_a_corrected_position_moves_the_sleepers_slowly_and_by_less_than_a_bay():
    n = round(2.0 * RATE)
    position = 25.0 * STEP * np.arange(n)
    position[n // 2:] += 7.0 * 0.6 + 0.2          # seven bays and a third
    nothing = {}
    samples = Samples(0, STEP, 0.0, position, np.full(n, 25.0), nothing, nothing)
    place = _place(samples, 0.6)
    moves = np.diff(place) / (25.0 * STEP)
    assert moves.min() > 0.94
    assert moves.max() < 1.06
    assert place[:n // 2] == pytest.approx(position[:n // 2])
    assert (position[-1] - place[-1]) / 0.6 == pytest.approx(7.0, abs=1e-9)


def test_positions_without_correction_are_the_way():
    position = 25.0 * STEP * np.arange(1000)
    samples = Samples(0, STEP, 0.0, position, np.full(1000, 25.0), {}, {})
    assert _place(samples, 0.6) is position


def test_the_time_step_is_a_whole_fraction_of_the_sample_period_and_no_longer_than_asked():
    assert oversampling(1 / 25600, 25e-6) == 2
    assert oversampling(1 / 2000, 25e-6) == 20
    assert oversampling(1 / 2000, 10e-6) == 50
    assert oversampling(1 / 51200, 25e-6) == 2


def test_a_smooth_rail_gives_the_static_load_and_the_sleeper_passing(table_3_1, bogie):
    """24 m/s over distributed supports: 98.90 to 100.92 kN with rigid wheels of 550 kg."""
    vehicle = dataclasses.replace(
        bogie, axle_boxes=bogie.axle_boxes[:1], wheel=dataclasses.replace(
            bogie.wheel, mass=550.0, static_load=100e3), contact=dataclasses.replace(
                bogie.contact, stiffness=100e9, exponent=1.5))
    rail = dataclasses.replace(table_3_1.rail, loss_factor=0.0)
    track = dataclasses.replace(table_3_1, rail=rail)
    n = round(0.8 * RATE)
    position = 24.0 * STEP * np.arange(n)
    name = vehicle.axle_boxes[0].name
    found = drive(make_bay(track, Mesh()), vehicle, position, {name: np.zeros(n)}, STEP)
    force = found['contact_force'][name]
    last = force[np.isfinite(force)][-round(0.1 * RATE):]
    assert last.min() == pytest.approx(98.90e3, abs=100.0)
    assert last.max() == pytest.approx(100.92e3, abs=100.0)
    assert np.isnan(force).sum() < 40


# A run from its recording to the results


def test_the_full_model_explains_a_run_that_a_finer_one_made(replayed):
    _, result = replayed
    for quantity, pair, share, decibels in (
            ('axle_box_acceleration', ('full_model', 'measured'), 0.01, 0.1),
            ('contact_force', ('full_model', 'truth'), 0.02, 0.15),
            ('contact_force', ('full_model', 'estimated'), 0.01, 0.1),
            ('rail_deflection', ('full_model', 'truth'), 0.01, 0.4),
            ('irregularity', ('estimated', 'truth'), 0.02, 0.2)):
        difference, reference = overall(result.replayed.errors, quantity, *pair)
        assert difference < share * reference, quantity
        assert abs(worst(result.replayed.errors, quantity, *pair).level_difference) < decibels
    assert result.defects == result.remarks == []


def test_forces_below_the_band_are_not_claimed(replayed):
    _, result = replayed
    band = result.replayed.band
    assert band.low == pytest.approx(20.0)
    frequencies = [e.frequency for e in result.replayed.errors if e.band == 'frequency']
    assert min(frequencies) > band.low
    assert max(frequencies) == pytest.approx(2511.9, abs=1.0)


def test_the_stretch_is_the_one_asked_for(replayed):
    _, result = replayed
    samples, stretch = result.replayed.samples, result.replayed.stretch
    assert samples.position[stretch.start] == pytest.approx(125.0, abs=2e-3)
    assert samples.position[stretch.start] >= 125.0
    assert samples.start_time + stretch.stop * STEP == pytest.approx(1.6, abs=2 * STEP)


def test_the_samples_of_a_stretch_are_those_of_the_whole_run(recording, table_3_1, bogie, replayed):
    whole = whole_run(recording, table_3_1, bogie, SETTINGS)
    part = replayed[1].replayed.samples
    first = round(part.start_time * RATE)
    assert first > 0
    assert part.position.size < whole.samples.position.size
    window = slice(first, first + part.position.size)
    for quantity, channels in part.estimated.items():
        for name, values in channels.items():
            assert np.array_equal(values, whole.samples.estimated[quantity][name][window],
                                  equal_nan=True)
    assert np.array_equal(part.position, whole.samples.position[window])


def test_comparison_csv_holds_every_signal_at_the_axle_boxes_own_place(replayed, bogie):
    output, result = replayed
    with open(output / 'comparison.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    assert {'time_s', 'axle_box', 'position_m', 'contact_force_estimated_n',
            'contact_force_full_model_n', 'contact_force_truth_n', 'rail_deflection_full_model_m',
            'axle_box_acceleration_measured_m_s2', 'irregularity_estimated_m'} <= set(rows[0])
    first = {row['axle_box']: row for row in reversed(rows)}
    assert set(first) == {box.name for box in bogie.axle_boxes}
    for box in bogie.axle_boxes:
        assert float(first[box.name]['position_m']) == pytest.approx(125.0 + box.offset, abs=2e-3)
    one = [row for row in rows if row['axle_box'] == bogie.axle_boxes[0].name]
    model, truth = (np.array([float(row[f'contact_force_{who}_n']) for row in one])
                    for who in ('full_model', 'truth'))
    # The model lacks what is longer than the cut-on, so by far not all of the difference is error.
    assert np.std(model - truth) < 0.1 * np.std(truth)
    assert np.mean(model) == pytest.approx(57e3, rel=0.01)


def test_errors_csv_is_the_error_table(replayed):
    output, result = replayed
    with open(output / 'errors.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(result.replayed.errors)
    assert {row['band'] for row in rows} == {'all', 'section', 'frequency', 'wavelength'}
    every = [row for row in rows if row['band'] == 'all']
    assert all(row['frequency_hz'] == '' for row in every)
    for row in rows:
        level = 20 * np.log10(float(row['rms_compared']) / float(row['rms_reference']))
        assert float(row['level_difference_db']) == pytest.approx(level, abs=1e-3)


def test_waveforms_of_the_model_stand_beside_those_of_the_run(replayed, recording, bogie):
    output, result = replayed
    name = bogie.axle_boxes[0].name
    with open_bag(output / 'replay.mcap') as bag, open_bag(recording) as measured:
        assert set(bag.topics) == {f'/full_model/{q}' for q in (
            'contact_force', 'rail_deflection', 'axle_box_acceleration', 'irregularity',
            'configuration')}
        force = read_waveform(bag, '/full_model/contact_force')
        truth = read_waveform(measured, '/truth/contact_force')
    first = int(np.searchsorted(truth.time_ns, force.time_ns[0] - 10))
    shared = slice(first, first + force.time_ns.size)
    assert np.abs(truth.time_ns[shared] - force.time_ns).max() <= 2       # ns
    assert force.position == pytest.approx(truth.position[shared], abs=1e-3)
    ours, true = force.channels[name], truth.channels[name][shared]
    assert np.isfinite(ours).all()
    assert np.corrcoef(ours, true)[0, 1] > 0.99


def test_the_report_tells_what_was_found(replayed):
    output, result = replayed
    page = (output / 'report.html').read_text()
    for sentence in result.report.findings:
        assert sentence.split(':')[0] in page
    assert any('true irregularity comes back' in text for text in result.report.findings)
    assert 'Butterworth high-pass of order 4' in page
    assert 'distributed, every 0.6 m' in page
    for plot in ('Along the track', 'Wavelength and place', 'Exceedance'):
        assert f'<h3>{plot}</h3>' in page
    assert len(page.encode()) < 10e6


def test_without_truth_nothing_is_said_of_it(replayed, bogie):
    found = replayed[1].replayed
    samples = dataclasses.replace(found.samples, truth={})
    measured = dataclasses.replace(
        found, samples=samples, truth_irregularity={},
        errors=[e for e in found.errors if 'truth' not in (e.compared, e.reference)])
    report = replay_report(measured, bogie, About('Measured', 'run'), Indicators([], {}))
    assert not any('true' in text for text in report.findings)
    assert all('truth' not in wave.curves for plot in (report.irregularity, *report.waveforms)
               for wave in plot.axle_boxes.values())
    assert all('truth' not in spectrum.levels for spectrum in report.spectra.values())
    assert not any('true' in column for table in report.tables for column in table.columns)


def test_a_dead_axle_box_still_loads_the_rail_and_is_not_compared(replayed, table_3_1, bogie):
    found = replayed[1].replayed
    dead = bogie.axle_boxes[1].name
    nothing = np.full(found.samples.position.size, np.nan)
    estimated = {q: {**channels, dead: nothing} for q, channels in found.samples.estimated.items()}
    samples = dataclasses.replace(found.samples, estimated=estimated,
                                  measured={**found.samples.measured, dead: nothing})
    again = replay(samples, found.stretch, make_bay(table_3_1, MESH), bogie, SETTINGS)
    assert {e.axle_box for e in again.errors if e.reference != 'truth'} == {
        bogie.axle_boxes[0].name}
    alive = bogie.axle_boxes[0].name
    deflection = again.full_model['rail_deflection'][alive]
    assert np.nanmean(deflection) == pytest.approx(
        np.nanmean(found.full_model['rail_deflection'][alive]), rel=0.01)


def test_a_stretch_too_short_to_settle_is_refused(recording, table_3_1, bogie, tmp_path):
    with pytest.raises(InputError, match='long enough to drive the full model'):
        replay_recording(recording, table_3_1, bogie, tmp_path / 'out',
                         Stretch(None, Bound(110.0, 'm')), mesh=MESH)
    assert list(tmp_path.iterdir()) == []


def test_a_gap_in_the_recording_is_not_bridged(recording, table_3_1, bogie, tmp_path):
    """Blocks between 0.8 s and 0.85 s are lost: the positions go on, the estimates begin anew."""
    path = tmp_path / 'gap.mcap'
    with read_run(recording, everything=True) as run, Recording(path) as copy:
        copy.write_facts(run.bag.facts)
        for event in run:
            message = event.message
            lost = (isinstance(event, AccelerationBlock)
                    and 0.8 <= (message.log_time - run.bag.start_time) / SECOND - 0.1 < 0.85)
            if not lost:
                copy.write_raw(message.topic, message.type, message.log_time, message.data)
    found = whole_run(path, table_3_1, bogie, SETTINGS)
    whole = whole_run(recording, table_3_1, bogie, SETTINGS)
    assert found.samples.position == pytest.approx(whole.samples.position, abs=1e-3)
    measured = found.samples.measured[bogie.axle_boxes[0].name]
    assert 0.04 < np.isnan(measured).sum() * STEP < 0.06
    irregularity = found.samples.estimated['irregularity'][bogie.axle_boxes[0].name]
    again = np.flatnonzero(np.isfinite(irregularity) & (np.arange(irregularity.size) * STEP > 0.85))
    metres = whole.samples.position[again[0]] - whole.samples.position[round(0.85 * RATE)]
    assert metres == pytest.approx(6.0, abs=0.5)


def test_latency_is_taken_from_a_live_recording_only(recording, table_3_1, bogie, tmp_path):
    path = tmp_path / 'live.mcap'
    with read_run(recording, everything=True) as run, Recording(path) as copy:
        for event in run:
            message = event.message
            if message.topic.startswith('/truth/'):
                continue
            copy.write_raw(message.topic, message.type, message.log_time, message.data)
            if isinstance(event, AccelerationBlock):
                block = event.block
                result = WaveformBlock(block.stamp_ns, block.t, {'a': np.zeros(block.samples)},
                                       np.zeros(block.samples))
                copy.write_waveform('/track_estimator/contact_force', result,
                                    message.log_time + 4_000_000)
    live = whole_run(path, table_3_1, bogie, SETTINGS).latency
    assert live.delay == pytest.approx(4e-3)
    assert live.delay.size == 200
    assert live.real_time_limit == pytest.approx(0.01)
    assert whole_run(recording, table_3_1, bogie, SETTINGS).latency is None


def test_an_interrupt_leaves_the_results_of_the_last_run(recording, table_3_1, bogie, tmp_path,
                                                         monkeypatch):
    output = tmp_path / 'out'
    output.mkdir()
    (output / 'comparison.csv').write_text('old')

    def interrupted(files, found):
        raise KeyboardInterrupt
    monkeypatch.setattr(replay_files.ReplayFiles, 'add', interrupted)
    with pytest.raises(KeyboardInterrupt):
        replay_recording(recording, table_3_1, bogie, output, mesh=MESH)
    assert [file.name for file in output.iterdir()] == ['comparison.csv']
    assert (output / 'comparison.csv').read_text() == 'old'


# The stretch and the command


# In windows, along the track, and over any track


def test_windows_give_the_errors_of_the_whole(recording, table_3_1, bogie, tmp_path):
    stretch = Stretch(Bound(0.6, 's'), Bound(1.8, 's'))
    whole, parts = (
        replay_recording(recording, table_3_1, bogie, tmp_path / str(window), stretch, mesh=MESH,
                         window=window).replayed for window in (8.0, 0.45))
    for quantity, pair in (('axle_box_acceleration', ('full_model', 'measured')),
                           ('contact_force', ('estimated', 'truth'))):
        for one, other in zip(overall(whole.errors, quantity, *pair),
                              overall(parts.errors, quantity, *pair), strict=True):
            assert other == pytest.approx(one, rel=0.15)
    assert parts.extent.begin == pytest.approx(whole.extent.begin, abs=0.01)
    assert parts.extent.end == pytest.approx(whole.extent.end, abs=0.01)
    assert parts.extent.duration == pytest.approx(whole.extent.duration, abs=2 * STEP)
    assert parts.extent.speeds == pytest.approx(whole.extent.speeds, rel=1e-3)
    times = []
    for name in ('8.0', '0.45'):
        with open_bag(tmp_path / name / 'replay.mcap') as bag:
            times.append(read_waveform(bag, '/full_model/contact_force').time_ns)
    np.testing.assert_allclose(*times, atol=2)      # ns: each sample once, none left out
    with open(tmp_path / '0.45' / 'comparison.csv', newline='') as file:
        rows = [r for r in csv.DictReader(file) if r['axle_box'] == bogie.axle_boxes[0].name]
    assert (np.diff([float(row['time_s']) for row in rows]) > 0.0).all()


def test_memory_does_not_grow_with_the_stretch(recording, table_3_1, bogie):
    """What a window hands over is as long as the window with what it needs around it."""
    taken = []
    estimate_run(recording, table_3_1, bogie, SETTINGS, Stretch(),
                 lambda samples, part, settings: taken.append((samples.position.size, part)),
                 window=0.4)
    assert len(taken) == 5
    assert sum(part.stop - part.start for _, part in taken) == 2 * RATE
    assert max(size for size, _ in taken) < 1.9 * RATE


def test_sections_of_an_axle_box_are_those_of_its_own_place(replayed, bogie):
    output, result = replayed
    sections = [e for e in result.replayed.errors if e.band == 'section'
                and e.quantity == 'contact_force' and e.compared == 'full_model'
                and e.reference == 'estimated']
    begin, end = result.replayed.compared
    for box in bogie.axle_boxes:
        places = sorted((e.begin, e.end) for e in sections if e.axle_box == box.name)
        assert places[0][0] <= begin + box.offset < places[0][1]
        assert [b for b, _ in places[1:]] == [e for _, e in places[:-1]]
        assert all(e - b == 10.0 for b, e in places)
    every = [e for e in result.replayed.errors if e.band == 'all'
             and e.quantity == 'contact_force' and e.compared == 'full_model'
             and e.reference == 'estimated']
    for line in every:
        parts = [e for e in sections if e.axle_box == line.axle_box]
        squares = sum(e.samples * e.rms_difference**2 for e in parts)
        total = sum(e.samples for e in parts)
        assert np.sqrt(squares / total) == pytest.approx(line.rms_difference, rel=0.02)


def test_coherence_is_1_through_a_filter_and_small_between_strangers():
    rng = np.random.default_rng(2)
    band = band_for(25.0, 3.0, STEP)
    noise, other = (band.limit(x) for x in rng.standard_normal((2, 60000)))
    distance = 25.0 * STEP * np.arange(noise.size)
    delayed = 3.0 * np.roll(noise, 7)
    lines = comparison.errors('contact_force', 'a', ('x', delayed), ('y', noise), distance, band)
    found = [e.coherence for e in lines if e.band == 'frequency' and e.frequency > 50.0]
    assert min(found) > 0.98
    lines = comparison.errors('contact_force', 'a', ('x', other), ('y', noise), distance, band)
    found = [e.coherence for e in lines if e.band == 'frequency' and e.frequency > 50.0]
    assert max(found) < 0.3


def test_a_short_record_claims_no_coherence():
    noise = np.random.default_rng(2).standard_normal(5000)
    lines = comparison.errors('contact_force', 'a', ('x', noise), ('y', noise),
                              25.0 * STEP * np.arange(noise.size), band_for(25.0, 3.0, STEP))
    assert lines
    assert all(np.isnan(e.coherence) for e in lines)


def test_merging_tables_averages_energies_with_the_samples_as_weights():
    def line(rms, samples, **other):
        return comparison.Error('contact_force', 'a', 'x', 'y', 'all', np.nan, np.nan, rms, rms,
                                rms, samples, **other)

    found, = comparison.merged([[line(3.0, 100)], [line(6.0, 300)]])
    assert found.rms_difference == pytest.approx(np.sqrt((9 + 3 * 36) / 4))
    assert found.samples == 400
    tables = [[line(1.0, 1, begin=0.0, end=10.0)], [line(1.0, 1, begin=10.0, end=20.0)]]
    assert len(comparison.merged(tables)) == 2


def test_the_stretch_that_the_model_does_not_explain_is_named(recording, table_3_1, bogie,
                                                              tmp_path):
    """The full model has pads a tenth as stiff from 130 to 140 m, the measured track has not."""
    first = bogie.axle_boxes[0].name
    support = table_3_1.support
    soft = dataclasses.replace(support, pad_stiffness=0.1 * support.pad_stiffness)
    uneven = dataclasses.replace(table_3_1, stretches=(
        TrackStretch(130.0, 139.9, table_3_1.rail, soft),))
    result = replay_recording(recording, table_3_1, bogie, tmp_path / 'out',
                              Stretch(Bound(0.9, 's'), None), model_track=uneven)
    named = unexplained(result.replayed.errors)
    assert {e.axle_box for e in named} == {box.name for box in bogie.axle_boxes}
    assert all((e.begin, e.end) == (130.0, 140.0) for e in named if e.axle_box == first)
    assert any('does not explain' in text and '130 m to 140 m' in text
               for text in result.report.findings)
    assert result.report.tables[0].rows
    assert result.summary['unexplained'][0]['from_m'] == 130.0


@pytest.mark.parametrize(('text', 'value', 'unit'), [
    ('120', 120.0, 'm'), ('120m', 120.0, 'm'), ('-1.5e2 m', -150.0, 'm'), ('4.5s', 4.5, 's')])
def test_ends_of_a_stretch_are_metres_or_seconds(text, value, unit):
    assert Bound.parse(text) == Bound(value, unit)


@pytest.mark.parametrize('text', ['', 'abc', '5 km', '1.2.3', 's'])
def test_other_ends_of_a_stretch_are_refused(text):
    with pytest.raises(InputError, match='expected a track position'):
        Bound.parse(text)


def test_an_empty_stretch_is_refused():
    with pytest.raises(InputError, match='from 20 m to 10 m is empty'):
        Stretch(Bound(20.0, 'm'), Bound(10.0, 'm'))


@pytest.mark.parametrize(('options', 'reason'), [
    (['--from', '900'], 'lies outside the run, which covers 100.0 m to 15'),
    (['--from', 'here'], 'argument --from: expected a track position'),
    (['--time-step', '100'], 'argument --time-step'),
    (['--vehicle', 'measurement_coach', '--acceleration-topic', 'speed'], 'expected sensor_msgs'),
])
def test_the_command_refuses_in_one_line(options, reason, recording, tmp_path, capfd):
    status = main(['replay', str(recording), '--track', 'blanco_table_3_1', '--vehicle',
                   'blanco_table_3_1', '--output', str(tmp_path / 'out'), *options])
    said = capfd.readouterr()
    assert status == 2
    assert reason in said.err
    assert said.err.count('\n') == 1
    assert not (tmp_path / 'out').exists()


def test_a_vehicle_without_any_channel_of_the_recording_is_refused(recording, table_3_1, bogie):
    boxes = tuple(dataclasses.replace(box, name=f'other_{box.name}') for box in bogie.axle_boxes)
    with pytest.raises(InputError, match='none of the axle boxes'):
        estimate_run(recording, table_3_1, dataclasses.replace(bogie, axle_boxes=boxes), SETTINGS,
                     Stretch(), lambda *samples: None)


def test_the_command_writes_its_files_and_a_summary(recording, bogie, tmp_path, capfd):
    vehicle = tmp_path / 'bogie.yaml'
    vehicle.write_text(f"""
wheel: {{mass: {bogie.wheel.mass}, static_load: {bogie.wheel.static_load}, radius: 0.46}}
contact: {{stiffness: {bogie.contact.stiffness}, exponent: {bogie.contact.exponent}}}
axle_boxes:
  - {{name: {bogie.axle_boxes[0].name}, rail: left, offset: 0.0}}
  - {{name: {bogie.axle_boxes[1].name}, rail: left, offset: {bogie.axle_boxes[1].offset}}}
""")
    output = tmp_path / 'out'
    status = main(['replay', str(recording), '--track', 'blanco_table_3_1', '--vehicle',
                   str(vehicle), '--output', str(output), '--from', '125', '--support',
                   'concentrated', '--elements-per-bay', '4', '--json'])
    summary = json.loads(capfd.readouterr().out)
    assert status == 0
    assert sorted(file.name for file in output.iterdir()) == sorted(summary['files'])
    assert summary['from_m'] >= 125.0
    force = next(e for e in summary['errors'] if (e['quantity'], e['compared'], e['reference'])
                 == ('contact_force', 'full_model', 'estimated'))
    # Another support than that of the run: worse than with the right one, and still alike.
    assert 0.02 < force['rms_difference'] / force['rms_reference'] < 0.5
    assert 'concentrated, every 0.6 m' in (output / 'report.html').read_text()


def test_where_there_is_no_truth_to_speak_of_its_error_is_counted_and_not_told(replayed, bogie):
    found = replayed[1].replayed
    quiet = [dataclasses.replace(e, rms_reference=1e-3 * e.rms_compared,
                                 rms_difference=e.rms_compared)
             if e.reference == 'truth' and e.band == 'frequency' and e.frequency < 60.0 else e
             for e in found.errors]
    report = replay_report(dataclasses.replace(found, errors=quiet), bogie, About('Quiet', 'run'))
    told = [text for text in report.findings if 'true' in text]
    assert len(told) == 2
    assert all('in which the difference is larger than the true one' in text for text in told)
    assert not any('60.00 dB' in text for text in told)
    assert not any('left out' in text for text in replayed[1].report.findings)
