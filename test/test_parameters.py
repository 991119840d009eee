"""What the strict YAML reader accepts, and the one line with which it refuses the rest."""

import pytest

from railtrack_ros.errors import InputError
from railtrack_ros.parameters import ANY, NOT_NEGATIVE, POSITIVE, Range, read_yaml


@pytest.fixture
def read(tmp_path):
    def read(text):
        path = tmp_path / 'case.yaml'
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_yaml(path)

    return read


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('2', 2.0),
        ('2.5e3', 2500.0),
        ('1e3', 1000.0),
        ('-1e-3', -0.001),
        ('2.1E11', 2.1e11),
        ('.5e1', 5.0),
        ('1_000', 1000.0),
    ],
)
def test_every_common_way_to_write_a_number_is_read(read, text, value):
    assert read(f'x: {text}').number('x') == value


@pytest.mark.parametrize(
    ('text', 'got'),
    [
        ('yes', 'true'),
        ('off', 'false'),
        ('"2"', "the text '2'"),
        ('fast', "the text 'fast'"),
        ('1e3 N', "the text '1e3 N'"),
        ('', 'nothing'),
        ('~', 'nothing'),
        ('[1]', 'a list'),
        ('{a: 1}', 'a mapping'),
        ('2026-01-01', '2026-01-01'),
        ('.nan', 'nan'),
        ('.inf', 'inf'),
        ('-.inf', '-inf'),
        ('1e999', 'inf'),
        ('1' + 400 * '0', 'inf'),
    ],
)
def test_what_is_no_finite_number_is_refused(read, text, got):
    with pytest.raises(InputError) as refusal:
        read(f'a: {{x: {text}}}').section('a').number('x')
    assert str(refusal.value).endswith(f'case.yaml: a.x: expected a number, got {got}')


@pytest.mark.parametrize(
    ('allowed', 'value', 'expected'),
    [
        (POSITIVE, 0, 'a number above 0'),
        (POSITIVE, -1, 'a number above 0'),
        (NOT_NEGATIVE, -1e-300, 'a number of at least 0'),
        (Range(above=-1.0, maximum=0.5), -1, 'a number above -1 and of at most 0.5'),
        (Range(above=-1.0, maximum=0.5), 0.51, 'a number above -1 and of at most 0.5'),
        (Range(below=2.0), 2, 'a number below 2'),
    ],
)
def test_a_number_outside_its_range_is_refused(read, allowed, value, expected):
    with pytest.raises(InputError, match=f': x: expected {expected}, got '):
        read(f'x: {value}').number('x', allowed)


def test_the_ends_of_a_range_belong_to_it_as_it_says(read):
    section = read('x: 0\ny: 0.5')
    assert section.number('x', NOT_NEGATIVE) == 0.0
    assert section.number('y', Range(maximum=0.5)) == 0.5


def test_an_unknown_key_suggests_the_one_that_was_meant(read):
    section = read('rail: {second_momnet: 1}').section('rail')
    with pytest.raises(InputError, match=r"rail\.second_momnet: unknown key; did you mean 'sec"):
        section.expect(['area', 'second_moment'])


def test_an_unknown_key_without_a_likeness_lists_the_known_ones(read):
    with pytest.raises(InputError, match='colour: unknown key; expected one of area, length'):
        read('colour: red').expect(['area'], ['length'])


@pytest.mark.parametrize('key', ['1', 'on', '2.5', '~', '2026-01-01'])
def test_a_key_that_is_no_text_is_unknown_too(read, key):
    with pytest.raises(InputError, match='unknown key'):
        read(f'{key}: 1').expect(['area'])


def test_a_missing_key_is_named(read):
    with pytest.raises(InputError, match=r'case\.yaml: area: missing key'):
        read('length: 1').expect(['area', 'length'])


def test_a_key_of_a_later_version_says_so(read):
    with pytest.raises(InputError, match='modes: not supported yet by this version'):
        read('modes: []').expect(['area'], not_yet=['modes'])


def test_a_key_given_twice_is_refused(read):
    with pytest.raises(InputError, match="line 3, column 1: the key 'area' is given twice"):
        read('area: 1\nlength: 2\narea: 3')


def test_anchors_and_merged_mappings_are_read(read):
    section = read('a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}').section('b')
    assert section.numbers({'x': ANY, 'y': ANY}) == {'x': 1.0, 'y': 3.0}


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', 'the file is empty'),
        ('# only a comment\n---\n', 'the file is empty'),
        ('- 1\n- 2\n', 'expected keys with values, got a list'),
        ('just words', "expected keys with values, got the text 'just words'"),
        ('rail: {area: 1', 'not valid YAML: line 1, column 15: '),
        ('rail:\n\tarea: 1', 'not valid YAML: line 2, column 1: '),
        ('a: 1\n---\nb: 2\n', 'not valid YAML: line 2, column 1: '),
        ('a: *b', 'not valid YAML: line 1, column 4: '),
        ('a: !!python/object:os.system {}', 'not valid YAML: line 1, column 4: '),
        ('a: 2026-99-99', 'not valid YAML: month must be in 1..12'),
        ('{[1]: 2}', 'not valid YAML: '),
        (b'\xff\xfe\x00broken\x80', 'not valid YAML: '),
        (b'\x80\x04K\x01.', 'not valid YAML: '),
        (5000 * '[', 'not valid YAML: '),
    ],
)
def test_a_file_that_is_no_mapping_of_yaml_is_refused_in_one_line(read, text, message):
    with pytest.raises(InputError) as refusal:
        read(text)
    told = str(refusal.value)
    assert f'case.yaml: {message}' in told
    assert '\n' not in told
    assert len(told) < 400


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(InputError, match='none.yaml: cannot be read: no such file'):
        read_yaml(tmp_path / 'none.yaml')
    with pytest.raises(InputError, match='cannot be read: is a directory'):
        read_yaml(tmp_path)


def test_the_entries_of_a_list_are_named_by_their_number(read):
    entries = read('boxes: [{offset: 1}, {offset: far}]').sections('boxes')
    assert entries[0].number('offset') == 1.0
    with pytest.raises(InputError, match=r'boxes\[1\]\.offset: expected a number'):
        entries[1].number('offset')


@pytest.mark.parametrize('text', ['boxes: []', 'boxes:', 'boxes: {a: 1}', 'boxes: 3'])
def test_a_list_must_have_entries(read, text):
    with pytest.raises(InputError, match='boxes: expected a list of at least one entry, got'):
        read(text).sections('boxes')


def test_an_entry_of_a_list_must_be_a_mapping(read):
    with pytest.raises(InputError, match=r'boxes\[0\]: expected keys with values, got 1'):
        read('boxes: [1]').sections('boxes')


def test_a_choice_is_one_of_those_offered(read):
    kinds = ('concentrated', 'distributed')
    assert read('kind: distributed').choice('kind', kinds) == 'distributed'
    with pytest.raises(InputError, match="kind: unknown value 'distribute'; did you mean 'dis"):
        read('kind: distribute').choice('kind', kinds)
    with pytest.raises(InputError, match='kind: expected one of concentrated, dist.*got 1'):
        read('kind: 1').choice('kind', kinds)


def test_text_is_text(read):
    assert read('a: 1').text('name', default='none') == 'none'
    with pytest.raises(InputError, match='name: expected text, got 12'):
        read('name: 12').text('name', default='none')
