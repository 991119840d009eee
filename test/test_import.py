import json
import sys
import tracemalloc

import h5py
import numpy as np
import pytest
import scipy.integrate
import scipy.io
import scipy.signal
from nptdms import ChannelObject, TdmsWriter

from railtrack_ros.bags.codec import SECOND, START_NS
from railtrack_ros.bags.import_settings import (
    Calibration,
    HighPass,
    ImportSettings,
    parse_calibration,
    parse_channels,
)
from railtrack_ros.bags.importers import import_measurement
from railtrack_ros.bags.reader import (
    AccelerationBlock,
    SpeedSample,
    open_bag,
    read_run,
    read_waveform,
)
from railtrack_ros.bags.survey import survey
from railtrack_ros.bags.writer import ACCELERATION_TOPIC
from railtrack_ros.cli.main import main
from railtrack_ros.errors import InputError

N, RATE = 4000, 2000.0
TIME = np.arange(N) / RATE
RNG = np.random.default_rng(2)
LEFT, RIGHT = RNG.normal(size=(2, N)).astype(np.float32).astype(np.float64)
SPEED = 15.0 + TIME


def settings(channels='left,right', **options):
    options = options or {'sample_rate': RATE, 'speed': 15.0}
    return ImportSettings(parse_channels(channels), **options)


def imported(tmp_path, path, how):
    """Import a file; return the summary and the acceleration of the recording."""
    summary = import_measurement(path, tmp_path / 'out.mcap', how)
    with open_bag(tmp_path / 'out.mcap') as bag:
        return summary, read_waveform(bag, ACCELERATION_TOPIC)


def csv(path, columns, *, header=True, delimiter=',', comma=False, encoding='utf-8'):
    lines = [delimiter.join(columns)] if header else []
    for row in zip(*columns.values(), strict=True):
        fields = [x if isinstance(x, str) else repr(float(x)) for x in row]
        lines.append(delimiter.join(x.replace('.', ',') if comma else x for x in fields))
    path.write_text('\n'.join(lines) + '\n', encoding=encoding)
    return path


def npz(path, **arrays):
    np.savez(path, **arrays)
    return path


# Files


COLUMNS = {'time': TIME, 'left': LEFT, 'right': RIGHT, 'v': SPEED}
BY_TIME = {'time_column': 'time', 'speed_column': 'v'}


def as_mat(path):
    scipy.io.savemat(path, COLUMNS)
    return path


def as_mat73(path):
    """Write what MATLAB writes with -v7.3: HDF5 behind a header, arrays transposed, a struct."""
    with h5py.File(path, 'w', userblock_size=512) as file:
        for name, values in COLUMNS.items():
            file[name if name != 'left' else 'run/left'] = values[None, :]
        file['#refs#/a'] = np.zeros(3)
        file['both'] = np.stack([LEFT, RIGHT])          # of N rows and two columns
    with path.open('r+b') as file:
        file.write(b'MATLAB 7.3 MAT-file'.ljust(116) + b'\0' * 8 + b'\0\2IM')
    return path


def as_hdf5(path):
    with h5py.File(path, 'w') as file:
        for name, values in COLUMNS.items():
            file.create_dataset(f'run 1/{name}', data=values, compression='gzip', chunks=(1000,))
        file['run 2/comment'] = 'text'
    return path


def as_tdms(path, **properties):
    with TdmsWriter(path) as file:
        file.write_segment([ChannelObject('run', name, values, properties)
                            for name, values in COLUMNS.items()])
    return path


def as_array(path):
    return npz(path, time=TIME, both=np.stack([LEFT, RIGHT], axis=1), v=SPEED)


FORMS = {
    'comma': lambda p: csv(p / 'x.csv', COLUMNS),
    'tab': lambda p: csv(p / 'x.tsv', COLUMNS, delimiter='\t'),
    'blanks': lambda p: csv(p / 'x.txt', COLUMNS, delimiter='  '),
    'semicolon': lambda p: csv(p / 'x.csv', COLUMNS, delimiter=';'),
    'decimal comma': lambda p: csv(p / 'x.csv', COLUMNS, delimiter=';', comma=True),
    'byte order mark': lambda p: csv(p / 'x.csv', COLUMNS, encoding='utf-8-sig'),
    'npz': lambda p: npz(p / 'x.npz', **COLUMNS),
    'npz of rows': lambda p: npz(p / 'x.npz', **{k: v[None, :] for k, v in COLUMNS.items()}),
    'mat': lambda p: as_mat(p / 'x.mat'),
    'mat 7.3': lambda p: as_mat73(p / 'x.mat'),
    'hdf5': lambda p: as_hdf5(p / 'x.h5'),
    'tdms': lambda p: as_tdms(p / 'x.tdms'),
}


@pytest.mark.parametrize('form', FORMS)
def test_every_form_of_file_gives_the_same_recording(tmp_path, form):
    summary, found = imported(tmp_path, FORMS[form](tmp_path), settings(**BY_TIME))
    np.testing.assert_array_equal(found.channels['left'], LEFT)
    np.testing.assert_array_equal(found.channels['right'], RIGHT)
    np.testing.assert_allclose(found.time(START_NS), TIME, atol=2e-9)
    assert summary.sample_rate == pytest.approx(RATE)
    assert summary.distance == pytest.approx(scipy.integrate.trapezoid(SPEED, TIME))
    assert summary.notes == []
    assert not summary.resampled


def test_columns_of_an_array_have_an_index(tmp_path):
    how = settings('both[1]=right,both[0]=left', **BY_TIME)
    _, found = imported(tmp_path, as_array(tmp_path / 'x.npz'), how)
    np.testing.assert_array_equal(found.channels['left'], LEFT)
    np.testing.assert_array_equal(found.channels['right'], RIGHT)


def test_columns_without_header_have_a_number(tmp_path):
    path = csv(tmp_path / 'x.csv', COLUMNS, header=False)
    _, found = imported(tmp_path, path, settings('2=left', time_column='1', speed_column='4'))
    np.testing.assert_array_equal(found.channels['left'], LEFT)


def test_comments_quotes_and_western_encoding_are_understood(tmp_path):
    path = csv(tmp_path / 'x.csv', {'"a (m/s²), left"': LEFT, 'µ': RIGHT}, encoding='latin-1')
    path.write_bytes(b'# logger 7\n\n' + path.read_bytes())
    _, found = imported(tmp_path, path, settings('µ=right'))
    np.testing.assert_array_equal(found.channels['right'], RIGHT)


def test_same_file_gives_the_same_bytes(tmp_path):
    path = npz(tmp_path / 'x.npz', **COLUMNS)
    for name in ('1.mcap', '2.mcap'):
        import_measurement(path, tmp_path / name, settings(**BY_TIME))
    assert (tmp_path / '1.mcap').read_bytes() == (tmp_path / '2.mcap').read_bytes()


# Units and time base


def test_units_are_converted(tmp_path):
    path = npz(tmp_path / 'x.npz', g=LEFT, km=2.0 + 0.020 * TIME / 1.0, v=np.full(N, 72.0))
    how = settings(
        'g=left',
        acceleration_unit='g',
        position_column='km',
        position_unit='km',
        speed_column='v',
        speed_unit='km/h',
    )
    summary, found = imported(tmp_path, path, how)
    np.testing.assert_allclose(found.channels['left'], 9.80665 * LEFT, rtol=1e-6)
    assert summary.start_position == pytest.approx(2000.0)
    assert summary.sample_rate == pytest.approx(RATE, rel=1e-6)
    with read_run(tmp_path / 'out.mcap') as run:
        assert run.start_position == summary.start_position
        assert {event.speed for event in run if isinstance(event, SpeedSample)} == {20.0}


def test_blocks_are_about_10_ms_and_speed_is_known_before_the_first(tmp_path):
    import_measurement(npz(tmp_path / 'x.npz', **COLUMNS), tmp_path / 'o', settings(**BY_TIME))
    with read_run(tmp_path / 'o') as run:
        events = list(run)
    times = [event.message.log_time for event in events]
    assert times == sorted(times)
    first = next(k for k, event in enumerate(events) if isinstance(event, AccelerationBlock))
    assert events[first].block.samples == 16
    assert [event.stamp_ns for event in events[:first]] == [
        START_NS - 100_000_000,
        START_NS - 50_000_000,
        START_NS,
    ]
    for event in events[first:]:
        if isinstance(event, SpeedSample):
            assert event.speed == pytest.approx(15.0 + (event.stamp_ns - START_NS) / SECOND)


def test_samples_of_equal_distance_become_samples_of_equal_time(tmp_path):
    """A 90 Hz vibration under a vehicle that brakes from 30 to 20 m/s, sampled every 8 mm."""
    position = 500.0 + 0.008 * np.arange(10_000)
    speed = np.sqrt(30.0**2 - 2 * 3.125 * (position - 500.0))
    time = (30.0 - speed) / 3.125
    path = npz(tmp_path / 'x.npz', x=position, v=speed, a=np.sin(2 * np.pi * 90.0 * time))
    how = settings('a', position_column='x', speed_column='v')
    summary, found = imported(tmp_path, path, how)
    assert summary.resampled
    assert summary.sample_rate == pytest.approx(30.0 / 0.008, rel=1e-3)
    # The uniform grid ends up to a sample before the last sample.
    assert 0.0 <= position[-1] - position[0] - summary.distance < 0.008
    t = found.time(START_NS)
    assert t[-1] == pytest.approx(time[-1], abs=1e-3)
    np.testing.assert_allclose(np.diff(t), 1.0 / summary.sample_rate, rtol=1e-4)
    np.testing.assert_allclose(found.channels['a'], np.sin(2 * np.pi * 90.0 * t), atol=2e-4)
    checked = survey(tmp_path / 'out.mcap')
    assert checked.distance == pytest.approx(summary.distance, rel=1e-4)
    assert checked.acceleration.gap_count == 0


def test_resampling_makes_nothing_up_where_samples_are_missing(tmp_path):
    position = 0.01 * np.arange(N)
    speed = np.linspace(20.0, 25.0, N)
    a = np.cos(position)
    a[1000:1100] = np.nan
    path = npz(tmp_path / 'x.npz', x=position, v=speed, a=a)
    summary, found = imported(tmp_path, path, settings('a', position_column='x', speed_column='v'))
    at = np.interp(found.time(START_NS), np.cumsum(np.r_[0, 0.02 / (speed[1:] + speed[:-1])]),
                   np.arange(N))  # fmt: skip
    missing = np.isnan(found.channels['a'])
    np.testing.assert_array_equal(missing, (at > 999 + 1e-6) & (at < 1100 - 1e-6))
    assert summary.missing == {'a': missing.sum()}
    np.testing.assert_allclose(
        found.channels['a'][~missing], np.cos(0.01 * at[~missing]), atol=1e-5
    )


# Gaps and missing values


def test_gap_begins_a_new_block_at_its_own_time(tmp_path):
    time = np.concatenate([TIME, 5.0 + TIME])
    path = npz(tmp_path / 'x.npz', t=time, a=np.tile(LEFT, 2), v=np.full(2 * N, 10.0))
    summary, found = imported(tmp_path, path, settings('a', time_column='t', speed_column='v'))
    np.testing.assert_allclose(found.time(START_NS), time, atol=1e-8)
    np.testing.assert_array_equal(found.channels['a'], np.tile(LEFT, 2))
    assert summary.gaps == 1
    assert '1 gaps, 3 s in all, the first at 2 s' in summary.notes[0]
    assert summary.distance == pytest.approx(10.0 * (time[-1] - time[0]))
    checked = survey(tmp_path / 'out.mcap').acceleration
    assert checked.gap_count == 1
    assert checked.gaps[0] == pytest.approx((TIME[-1], 5.0 - TIME[-1] - 1 / RATE))
    with read_run(tmp_path / 'out.mcap') as run:
        stamps = [x.stamp_ns - START_NS for x in run if isinstance(x, SpeedSample)]
    assert {4_900_000_000, 4_950_000_000, 5_000_000_000} <= set(stamps)


def test_gap_in_position_keeps_the_place_on_the_track(tmp_path):
    position = np.delete(100.0 + 0.01 * np.arange(N), np.s_[1000:1500])
    path = npz(tmp_path / 'x.npz', x=position, a=np.delete(LEFT, np.s_[1000:1500]))
    summary, found = imported(tmp_path, path, settings('a', position_column='x', speed=20.0))
    assert summary.gaps == 1
    assert not summary.resampled
    place = summary.start_position + 20.0 * found.time(START_NS)
    np.testing.assert_allclose(place, position, atol=1e-6)


def test_single_samples_between_gaps_are_dropped_and_counted(tmp_path):
    time = np.concatenate([TIME, [7.0, 8.0], 9.0 + TIME])
    a = np.concatenate([LEFT, [0.0, 0.0], LEFT])
    path = npz(tmp_path / 'x.npz', t=time, a=a)
    summary, found = imported(tmp_path, path, settings('a', time_column='t', speed=10.0))
    assert found.time_ns.size == 2 * N
    assert any('2 samples dropped' in note for note in summary.notes)


def test_empty_fields_stay_missing_samples(tmp_path):
    left = [f'{x!r}' for x in LEFT.tolist()]
    left[10:13] = ['', 'NaN', ' ']
    right = [f'{x!r}' for x in RIGHT.tolist()]
    right[20] = 'inf'
    path = csv(tmp_path / 'x.csv', {'left': left, 'right': right})
    summary, found = imported(tmp_path, path, settings())
    assert np.flatnonzero(np.isnan(found.channels['left'])).tolist() == [10, 11, 12]
    assert np.flatnonzero(np.isnan(found.channels['right'])).tolist() == [20]
    assert summary.missing == {'left': 3, 'right': 1}
    assert 'channel left: 3 samples have no value' in summary.notes[0]
    np.testing.assert_array_equal(found.channels['left'][13:], LEFT[13:])


# Refusals


def refuse(tmp_path, said, how, **columns):
    path = npz(tmp_path / 'x.npz', **{'a': LEFT, 't': TIME, 'x': 10 * TIME, 'v': SPEED, **columns})
    with pytest.raises(InputError, match=said) as caught:
        import_measurement(path, tmp_path / 'out.mcap', how)
    assert str(path) in str(caught.value)
    assert not (tmp_path / 'out.mcap').exists()


def changed(values, at, to):
    values = values.copy()
    values[at] = to
    return values


def test_unusable_columns_are_named_with_the_row(tmp_path):
    by_time = settings('a', time_column='t', speed=10.0)
    by_way = settings('a', position_column='x', speed_column='v')
    said = "no column 'acc'; there are: a, t, x, v"
    refuse(tmp_path, said, settings('acc', sample_rate=RATE, speed=1.0))
    refuse(tmp_path, "no column 'vv'; did you mean 'v'", settings('a', sample_rate=1e3,
           speed_column='vv'))  # fmt: skip
    refuse(tmp_path, "column 't' does not increase at row 11", by_time,
           t=changed(TIME, 10, TIME[9]))  # fmt: skip
    refuse(tmp_path, "column 't' has no value at row 4", by_time, t=changed(TIME, 3, np.nan))
    refuse(tmp_path, "'x' does not increase at row 2.*must grow with the run", by_way, x=-TIME)
    refuse(tmp_path, 'speed is zero at row 6', by_way, v=changed(SPEED, 5, 0.0))
    refuse(tmp_path, "'v': -1 m/s at row 6 is negative", by_way, v=changed(SPEED, 5, -1.0))
    refuse(tmp_path, "'v': 260 m/s at row 1 is too fast; see --speed-unit", by_way, v=260 + TIME)
    refuse(tmp_path, "column 'v' holds no numbers", by_way, v=np.full(N, np.nan))
    refuse(tmp_path, "column 'a' holds no numbers", by_time, a=np.full(N, np.nan))
    refuse(tmp_path, 'columns of different length: a has 3999, t has 4000', by_time, a=LEFT[1:])
    refuse(tmp_path, 'sample rate comes out as 2e\\+06 Hz; check the units', by_time, t=TIME / 1e3)
    refuse(tmp_path, '8 rows, expected a waveform', by_time, t=TIME[:8], a=LEFT[:8])
    single = np.repeat(np.arange(N // 5), 5) + np.tile([0.0, 0.1, 0.2, 0.3, 0.4], N // 5) / 100
    refuse(tmp_path, 'no 16 samples without a gap', by_time, t=single)
    refuse(tmp_path, 'the sample period varies so much', by_time,
           t=TIME + np.arange(N) ** 2)  # fmt: skip


@pytest.mark.parametrize(
    ('name', 'content', 'said'),
    [
        ('x.csv', 'left,right\n1,2\n1,two\n', "line 3: column 'right' holds 'two', expected a num"),
        ('x.csv', 'left,right\n1,2\n1\n', 'line 3: 1 fields, expected 2'),
        ('x.csv', 'left,left,right\n1,2,3\n', "2 columns are called 'left'"),
        ('x.csv', '', 'holds no rows'),
        ('x.csv', 'left,right\n', 'holds no rows'),
        ('x.csv', b'left,right\n\0\0', 'is not a text file'),
        ('x.csv', 'left,right\n' + '1,2\n' * 9, '9 rows, expected'),
        ('x.npz', b'PK\3\4 nonsense', 'is not an NPZ file'),
        ('x.npz', b'', 'is not an NPZ file'),
        ('x.mat', b'nonsense' * 40, 'is not a MAT file'),
        ('x.mat', b'', 'is not a MAT file'),
        ('x.mat', b'MATLAB 7.3 MAT-file'.ljust(124) + b'\0\2IM', 'is not a MAT file'),
        ('x.mat', b'M'.ljust(512) + b'\x89HDF\r\n\x1a\n cut', 'is not an undamaged MAT file'),
        ('x.h5', b'', 'is not an undamaged HDF5 file'),
        ('x.hdf5', b'\x89HDF\r\n\x1a\n' + b'\0' * 3000, 'is not an undamaged HDF5 file'),
        ('x.tdms', b'', 'x.tdms'),
        ('x.tdms', b'TDSm' + b'\xff' * 200, "no column 'left'; there are: none"),
        ('x.tdms', b'nonsense' * 40, 'is not an undamaged TDMS file'),
        ('x.xlsx', b'', "unknown kind of file '.xlsx'"),
        ('x', b'', 'unknown kind of file'),
    ],
)
def test_unreadable_files_are_refused_in_one_line(tmp_path, name, content, said):
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError, match=said) as caught:
        import_measurement(path, tmp_path / 'out.mcap', settings())
    assert str(path) in str(caught.value)


def test_pickled_arrays_are_not_unpickled(tmp_path):
    path = npz(tmp_path / 'x.npz', left=np.array([{}, {}], dtype=object), right=RIGHT)
    with pytest.raises(InputError, match='is not an NPZ file of plain arrays'):
        import_measurement(path, tmp_path / 'out.mcap', settings())


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('', "'' cannot name a channel"),
        ('left,', "'' cannot name a channel"),
        ('a b', "'a b' cannot name a channel.*give COLUMN=NAME"),
        ('x=t', "'t' cannot name a channel"),
        ('x=position', "'position' cannot name a channel"),
        ('x=1st', "'1st' cannot name a channel"),
        ('a,a', "'a': column or name given twice"),
        ('a=x,b=x', "'b=x': column or name given twice"),
    ],
)
def test_channels_that_cannot_be_are_refused(text, said):
    with pytest.raises(InputError, match=said):
        parse_channels(text)


def test_column_names_may_hold_an_equals_sign():
    assert parse_channels('a=1 = left , right') == {'a=1': 'left', 'right': 'right'}


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        ({'speed': 1.0, 'sample_rate': 1.0, 'time_column': 't'}, 'give one of --sample-rate'),
        ({'sample_rate': 1.0}, 'give one of --speed-column, --speed'),
        ({'sample_rate': 1.0, 'speed': 1.0, 'speed_column': 'v'}, 'give one of --speed-column'),
        ({'sample_rate': 1.0, 'speed': 1.0, 'speed_unit': 'mph'}, '--speed-unit mph: expected m/s'),
    ],
)
def test_contradicting_options_are_refused(options, said):
    with pytest.raises(InputError, match=said):
        settings('a', **options)


# The command, and real measurements


def test_command_tells_what_it_did(tmp_path, capsys):
    path, out = npz(tmp_path / 'x.npz', **COLUMNS), tmp_path / 'run'
    options = ['--channels', 'left', '--time-column', 'time', '--speed-column', 'v', str(out)]
    assert main(['import', str(path), *options]) == 0
    said = capsys.readouterr()
    assert said.err == ''
    assert '1 channels at 2000 Hz, 2.000 s, 32.0 m, 250 blocks' in said.out
    assert survey(out).obstacles == []


def test_command_ends_with_status_3_where_values_are_missing(tmp_path, capsys):
    path = npz(tmp_path / 'x.npz', a=changed(LEFT, 5, np.nan))
    options = ['--channels', 'a', '--sample-rate', '2000', '--speed', '72', '--speed-unit', 'km/h']
    assert main(['import', str(path), *options, str(tmp_path / 'o.mcap'), '--json']) == 3
    said = capsys.readouterr()
    assert said.err == f'railtrack import: {path}: channel a: 1 samples have no value\n'
    assert json.loads(said.out)['missing_samples'] == {'a': 1}
    with read_run(tmp_path / 'o.mcap') as run:
        assert {event.speed for event in run if isinstance(event, SpeedSample)} == {20.0}


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        (['--sample-rate', '0'], 'argument --sample-rate: expected a number above 0'),
        (['--sample-rate', '1', '--position-unit', 'km'], '--position-unit needs a --position-col'),
        ([], 'give one of --sample-rate, --time-column, --position-column'),
    ],
)
def test_command_refuses_in_one_line(tmp_path, capsys, options, said):
    path = npz(tmp_path / 'x.npz', a=LEFT)
    fixed = ['import', str(path), '--channels', 'a', '--speed', '1', str(tmp_path / 'o.mcap')]
    assert main([*fixed, *options]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count('\n') == 1


@pytest.mark.parametrize(
    ('name', 'rate', 'start'),
    [('measured_normal_a', 1987.0, 1000.0), ('measured_corrugated_a', 2090.8, 2000.0)],
)
def test_measured_run_is_taken_as_it_is(reference_data, tmp_path, name, rate, start):
    path = reference_data / f'{name}.npz'
    if not path.exists():
        pytest.skip(f'no {path.name}')
    how = settings(
        'left=axle1_left,right=axle1_right',
        position_column='position_km',
        position_unit='km',
        speed_column='speed_km_h',
        speed_unit='km/h',
    )
    summary, found = imported(tmp_path, path, how)
    with np.load(path) as measured:
        left, right = measured['left'], measured['right']
        position = 1e3 * measured['position_km']
        speed = measured['speed_km_h'][0] / 3.6
    assert summary.notes == []
    assert not summary.resampled
    assert summary.sample_rate == pytest.approx(rate, abs=0.1)
    assert summary.start_position == pytest.approx(start)
    np.testing.assert_array_equal(found.channels['axle1_left'], left)
    np.testing.assert_array_equal(found.channels['axle1_right'], right)
    place = summary.start_position + speed * found.time(START_NS)
    np.testing.assert_allclose(place, position, atol=0.005)  # half a sample of 9 mm
    checked = survey(tmp_path / 'out.mcap')
    assert checked.obstacles == []
    assert checked.distance == pytest.approx(position[-1] - position[0], abs=0.01)


# Groups, and what is done to sensors' numbers


def test_arrays_in_groups_have_paths_and_short_names_where_these_are_unmistakable(tmp_path):
    with h5py.File(tmp_path / 'x.h5', 'w') as file:
        file['first/a'], file['second/a'], file['second/b'] = LEFT, RIGHT, SPEED
    _, found = imported(tmp_path, tmp_path / 'x.h5', settings('second/a=right,b'))
    np.testing.assert_array_equal(found.channels['right'], RIGHT)
    np.testing.assert_allclose(found.channels['b'], SPEED, rtol=1e-6)
    with pytest.raises(InputError, match="no column 'a'.*first/a, second/a"):
        imported(tmp_path, tmp_path / 'x.h5', settings('a'))


def test_columns_of_a_mat_7_3_array_are_those_that_matlab_shows(tmp_path):
    _, found = imported(tmp_path, as_mat73(tmp_path / 'x.mat'),
                        settings('both[0]=left,both[1]=right'))
    np.testing.assert_array_equal(found.channels['left'], LEFT)
    np.testing.assert_array_equal(found.channels['right'], RIGHT)


def test_tdms_may_tell_its_own_sample_rate(tmp_path):
    path = as_tdms(tmp_path / 'x.tdms', wf_increment=1.0 / RATE)
    summary, _ = imported(tmp_path, path, settings(speed=15.0))
    assert summary.sample_rate == pytest.approx(RATE)
    with pytest.raises(InputError, match='does not tell its sample rate; give one of'):
        imported(tmp_path, as_tdms(tmp_path / 'y.tdms'), settings(speed=15.0))
    with pytest.raises(InputError, match='does not tell its sample rate'):
        imported(tmp_path, csv(tmp_path / 'y.csv', COLUMNS), settings(speed=15.0))


def test_tdms_that_was_cut_off_is_read_as_far_as_it_goes_and_that_is_said(tmp_path):
    path = as_tdms(tmp_path / 'x.tdms', wf_increment=1.0 / RATE)
    path.write_bytes(path.read_bytes()[:-3 * 8 * N // 2])
    summary, found = imported(tmp_path, path, settings('left', speed=15.0))
    np.testing.assert_array_equal(found.channels['left'], LEFT[:found.time_ns.size])
    assert any('cut off' in note for note in summary.notes)


def test_libraries_are_asked_for_only_where_their_files_are_read(tmp_path, monkeypatch):
    as_hdf5(tmp_path / 'x.h5')
    (tmp_path / 'x.tdms').touch()
    monkeypatch.setitem(sys.modules, 'h5py', None)
    monkeypatch.setitem(sys.modules, 'nptdms', None)
    imported(tmp_path, csv(tmp_path / 'x.csv', COLUMNS), settings())
    for path, package in ((tmp_path / 'x.h5', 'h5py'), (tmp_path / 'x.tdms', 'npTDMS')):
        with pytest.raises(InputError, match=f'takes the package {package}'):
            imported(tmp_path, path, settings())


@pytest.mark.parametrize('base', ['time', 'position'])
def test_sensitivity_offset_and_polarity_are_those_of_each_channel(tmp_path, base):
    volts = {'left': 0.01 * LEFT / 9.80665 + 2.5, 'right': -0.1 * RIGHT}
    columns = {**volts, 'x': 15.0 * TIME, 'v': np.full(N, 15.0)}
    how = ImportSettings(
        parse_channels('left=a,right=b'), 'g',
        calibration=parse_calibration(['a', 'b'], 'a=0.01,b=0.1', 'a=2.5', 'b'),
        **({'sample_rate': RATE, 'speed': 15.0} if base == 'time'
           else {'position_column': 'x', 'speed_column': 'v'}))
    _, found = imported(tmp_path, csv(tmp_path / 'x.csv', columns), how)
    np.testing.assert_allclose(found.channels['a'], LEFT, atol=1e-5)
    np.testing.assert_allclose(found.channels['b'], 9.80665 * RIGHT, rtol=1e-6, atol=1e-5)
    with open_bag(tmp_path / 'out.mcap') as bag:
        assert bag.facts['calibration a'] == 'sensitivity 0.01, offset 2.5'
        assert bag.facts['calibration b'].endswith('inverted')


def test_one_number_calibrates_all_channels():
    found = parse_calibration(['a', 'b'], '0.5', None, 'all')
    assert found == {name: Calibration(0.5, 0.0, True) for name in ('a', 'b')}
    assert parse_calibration(['a', 'b'], None, None, None) == {}


@pytest.mark.parametrize(('options', 'said'), [
    (('x=1', None, None), "--sensitivity: no channel 'x'; they are: a, b"),
    (('a=one', None, None), '--sensitivity a=one: expected NUMBER'),
    (('0', None, None), 'expected a number but 0'),
    ((None, 'nan', None), 'expected a finite number'),
    ((None, None, 'c'), "--invert: no channel 'c'"),
])
def test_calibration_that_cannot_be_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        parse_calibration(['a', 'b'], *options)


@pytest.mark.parametrize('order', [1, 2])
def test_an_undone_high_pass_gives_level_and_phase_back(tmp_path, order):
    """A sine at the corner, where the sensor lost 3 dB and shifted the phase."""
    time = np.arange(40 * N) / RATE
    wave = np.sin(2.0 * np.pi * 2.0 * time) + 0.3 * np.sin(2.0 * np.pi * 9.0 * time)
    poles = scipy.signal.butter(order, 2.0, 'high', fs=RATE, output='sos')
    sensed = scipy.signal.sosfilt(poles, wave)
    assert np.abs(sensed - wave)[-N:].max() > 0.5
    path = npz(tmp_path / 'x.npz', a=sensed)
    how = settings('a', sample_rate=RATE, speed=15.0,
                   undo_high_pass=HighPass.parse(f'2:{order}:0.02'))
    _, found = imported(tmp_path, path, how)
    late = slice(-8 * N, None)
    np.testing.assert_allclose(found.channels['a'][late], wave[late], atol=0.03)


@pytest.mark.parametrize(('text', 'said'), [
    ('fast', 'expected HZ'), ('1:2:3:4', 'expected HZ'), ('0.5:1:0.5', 'HZ above LOWEST'),
    ('1:9', 'order from 1 to 4'), ('nan', 'HZ above LOWEST'),
])
def test_high_passes_that_cannot_be_are_refused(text, said):
    with pytest.raises(InputError, match=said):
        HighPass.parse(text)


def test_decimation_keeps_what_is_below_the_new_band_and_folds_nothing_into_it(tmp_path):
    keep, fold = np.sin(2.0 * np.pi * 100.0 * TIME), np.sin(2.0 * np.pi * 430.0 * TIME)
    path = npz(tmp_path / 'x.npz', a=keep + fold)
    summary, found = imported(
        tmp_path, path, settings('a', sample_rate=RATE, speed=15.0, decimate=4))
    assert summary.sample_rate == pytest.approx(RATE / 4)
    inner = slice(50, -50)
    np.testing.assert_allclose(found.channels['a'][inner], keep[::4][inner], atol=2e-4)
    np.testing.assert_allclose(found.time(START_NS), TIME[::4], atol=2e-9)


def test_decimation_spreads_a_missing_sample_no_further_than_its_weight(tmp_path):
    values = np.sin(2.0 * np.pi * 20.0 * TIME)
    values[2000] = np.nan
    path = npz(tmp_path / 'x.npz', a=values)
    _, found = imported(tmp_path, path, settings('a', sample_rate=RATE, speed=15.0, decimate=4))
    missing = np.flatnonzero(np.isnan(found.channels['a']))
    assert missing.tolist() == [499, 500, 501]


def test_the_command_takes_sensors_as_they_are(tmp_path, capsys):
    path = as_tdms(tmp_path / 'x.tdms', wf_increment=1.0 / RATE)
    assert main(['import', str(path), '--channels', 'left,right', '--acceleration-unit', 'g',
                 '--sensitivity', 'left=0.1,right=-0.2', '--offset', '0.5', '--invert', 'left',
                 '--undo-high-pass', '0.5', '--decimate', '2', '--speed-column', 'v',
                 str(tmp_path / 'out.mcap'), '--json']) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary['sample_rate_hz'] == pytest.approx(RATE / 2)
    with open_bag(tmp_path / 'out.mcap') as bag:
        assert bag.facts['decimated by'] == '2'
        assert bag.facts['undone high-pass'] == '0.5:1:0.05'
    assert main(['import', str(path), '--channels', 'left,right', '--speed', '15',
                 '--undo-high-pass', '900', str(tmp_path / 'out.mcap')]) == 2
    assert 'above a tenth of the sample rate' in capsys.readouterr().err


# Memory


def many_ways(tmp_path):
    """Yield imports that go through every step: file, how, and what the recording is called."""
    rng = np.random.default_rng(3)
    left, right = LEFT.copy(), RIGHT.copy()
    left[[0, 1, 500, 776, 777, 778, 1554, N - 1]] = np.nan
    left[1990:2030] = np.nan
    time = TIME + np.where(TIME > 1.2, 0.3, 0.0)
    v = SPEED + 0.1 * rng.standard_normal(N)
    v[[0, 700, 777, N - 2, N - 1]] = np.nan
    columns = {'time': time, 'left': left, 'right': right, 'v': v}
    known = np.interp(np.arange(N), np.flatnonzero(np.isfinite(v)), v[np.isfinite(v)])
    columns['x'] = 100.0 + scipy.integrate.cumulative_trapezoid(known, TIME, initial=0.0)
    columns['v m/s'] = known
    files = [npz(tmp_path / 'a.npz', **columns),
             npz(tmp_path / 'b.npz', rows=np.stack(list(columns.values()), axis=1)),
             csv(tmp_path / 'c.csv', {
                 k: ['' if np.isnan(value) else repr(float(value)) for value in x]
                 for k, x in columns.items()})]
    for path, names in zip(files, [list(columns), [f'rows[{k}]' for k in range(6)],
                                   list(columns)], strict=True):
        time, left, right, v, x, steady = names
        channels = f'{left}=left,{right}=right'
        yield path, settings(channels, time_column=time, speed_column=v)
        yield path, settings(channels, time_column=time, speed_column=v, decimate=2,
                             undo_high_pass=HighPass.parse('5:2'),
                             calibration={'left': Calibration(0.1, 0.5, True)})
        yield path, settings(channels, position_column=x, speed_column=steady)


def test_a_file_read_in_pieces_gives_what_it_gives_as_a_whole(tmp_path, monkeypatch):
    modules = [sys.modules[f'railtrack_ros.bags.{name}']
               for name in ('columns', 'importers', 'stretches', 'tables')]
    for number, (path, how) in enumerate(many_ways(tmp_path)):
        found = []
        for piece in (1 << 16, 777):
            for module in modules:
                monkeypatch.setattr(module, 'PIECE', piece)
            found.append(imported(tmp_path, path, how))
        (whole, waves), (summary, pieces) = found
        assert (summary.samples, summary.gaps, summary.missing, summary.notes) == (
            whole.samples, whole.gaps, whole.missing, whole.notes), number
        assert summary.distance == pytest.approx(whole.distance, rel=1e-12)
        np.testing.assert_array_equal(pieces.time_ns, waves.time_ns)
        for name, samples in waves.channels.items():
            np.testing.assert_allclose(pieces.channels[name], samples, rtol=1e-6, atol=1e-6)
            assert np.isfinite(samples).mean() > 0.5


def test_memory_of_an_import_does_not_grow_with_the_file(tmp_path):
    def most(rows):
        path = npz(tmp_path / f'{rows}.npz', left=np.ones(rows), v=np.full(rows, 20.0))
        how = settings('left', sample_rate=10e3, speed_column='v', decimate=2,
                       undo_high_pass=HighPass.parse('0.5'))
        tracemalloc.start()
        import_measurement(path, tmp_path / 'out.mcap', how)
        largest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return largest

    few = most(300_000)
    assert most(1_200_000) < 1.2 * few
