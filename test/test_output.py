"""Results appear whole or not at all."""

import csv
import math
import os
import threading

import numpy as np
import pytest

from railtrack_ros.errors import InputError
from railtrack_ros.output import metres, refuse_inputs, replacing, write_csv


def write_half(target, reason):
    with replacing(target) as place:
        place.write_text('half')
        raise reason


def test_a_file_appears_when_it_is_complete(tmp_path):
    target = tmp_path / 'new' / 'folder' / 'result.mcap'
    with replacing(target) as place:
        assert place.name == 'result.mcap'  # writers look at the suffix, bags at the name
        place.write_text('half')
        assert not target.exists()
    assert target.read_text() == 'half'
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize(('position', 'text'), [
    (350000.4, '350000.4'), (1234567.89, '1234567.89'), (0.325, '0.325'), (-12.0, '-12'),
    (-1e-9, '0'), (100.0, '100'), (23.9999999, '24'),
])
def test_positions_keep_their_centimetres_far_out(position, text):
    assert metres(position) == text


def test_text_that_is_no_path_is_no_input(tmp_path):
    refuse_inputs(tmp_path / 'out.csv', ['x' * 5000, 'no\0path', '~nobody/x', '', 'sine:1:1e-6'])
    refuse_inputs('/dev/null', ['/dev/null'])  # nothing to lose


@pytest.mark.parametrize('reason', [KeyboardInterrupt, ValueError])
def test_an_interrupted_run_leaves_what_was_there_before(tmp_path, reason):
    target = tmp_path / 'result.csv'
    target.write_text('before')
    with pytest.raises(reason):
        write_half(target, reason)
    assert target.read_text() == 'before'
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_appears_under_its_name(tmp_path):
    target = tmp_path / 'run'
    with replacing(target) as place:
        place.mkdir()
        (place / 'metadata.yaml').write_text('x')
    assert (target / 'metadata.yaml').read_text() == 'x'
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_with_something_in_it_is_never_replaced(tmp_path):
    (tmp_path / 'kept').write_text('x')
    with pytest.raises(InputError, match='is a folder that is not empty'), replacing(tmp_path):
        pytest.fail('nothing may be computed for an output that cannot be written')
    assert (tmp_path / 'kept').read_text() == 'x'


def test_an_empty_folder_takes_a_folder_and_refuses_a_file(tmp_path):
    target = tmp_path / 'run'
    target.mkdir()
    with pytest.raises(InputError, match='run: is a folder; name a file'):
        write_csv(target, {'a': [1]})
    with replacing(target) as place:
        place.mkdir()
        (place / 'x').write_text('x')
    assert (target / 'x').exists()


def test_a_link_stays_a_link_to_what_it_names(tmp_path):
    real, link = tmp_path / 'real.csv', tmp_path / 'link.csv'
    real.write_text('before')
    link.symlink_to(real)
    write_csv(link, {'a': [1]})
    assert link.is_symlink()
    assert real.read_text() == 'a\n1\n'


def test_a_file_in_place_of_a_folder_is_told(tmp_path):
    (tmp_path / 'file').write_text('x')
    with pytest.raises(InputError, match='file/result.csv: cannot be written: '):
        write_csv(tmp_path / 'file' / 'result.csv', {'a': [1]})


def test_devices_and_pipes_are_written_to_directly(tmp_path):
    write_csv('/dev/null', {'a': [1]})
    assert not os.path.isfile('/dev/null')
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    writer = threading.Thread(target=write_csv, args=(pipe, {'a': [1]}))
    writer.start()
    assert pipe.read_text() == 'a\n1\n'
    writer.join()


def test_csv_numbers_read_back_as_they_were_and_nan_is_empty(tmp_path):
    values = np.array([1 / 3, math.pi * 1e-12, math.nan, -0.0, 1e300])
    write_csv(tmp_path / 'x.csv', {'value': values, 'name': list('abcde'), 'n': np.arange(5)})
    with open(tmp_path / 'x.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    assert rows[2]['value'] == ''
    read = [float(row['value']) for row in rows if row['value']]
    assert read == [value for value in values if not math.isnan(value)]
    assert [row['name'] for row in rows] == list('abcde')
    assert rows[4]['n'] == '4'


def test_csv_columns_of_different_length_are_a_mistake(tmp_path):
    with pytest.raises(ValueError, match='shorter'):
        write_csv(tmp_path / 'x.csv', {'a': [1, 2], 'b': [1]})
    assert not (tmp_path / 'x.csv').exists()
