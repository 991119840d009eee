"""The parts of the nodes that need no ROS graph: guard, diagnostics, parameters, playback."""

import dataclasses
import itertools
import math
import time

import pytest
import yaml
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from railtrack_ros.bags.codec import SECOND, decode_stamp, encode_header
from railtrack_ros.bags.message_types import LIVE, OFFLINE
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Health
from railtrack_ros.node import diagnostics, parameter_file
from railtrack_ros.node.diagnostics import ERROR, OK, WARN, Picture
from railtrack_ros.node.guard import QUIET_PERIOD, Guard, Voice
from railtrack_ros.node.latency import Latency, LatencyFigures
from railtrack_ros.node.limits import Limits
from railtrack_ros.node.parameters import setting
from railtrack_ros.node.playback import ahead, restamped
from railtrack_ros.node.processes import ros_parameters
from railtrack_ros.node.track_estimator import SETTINGS
from railtrack_ros.node.watch import Signal, Stamps
from railtrack_ros.parameters import EXPONENT_NUMBER
from railtrack_ros.paths import config_directory
from railtrack_ros.vehicle.description import load_vehicle


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


# The guard


def refuse(message):
    raise InputError(message)


def test_a_refusal_is_told_at_once_and_then_only_from_time_to_time():
    clock, said = Clock(), []
    guard = Guard(Voice(clock), said.append, said.append)
    for number in range(50):
        guard.call('/speed', refuse, f'value {number}')
        clock.now += 0.01
    guard.call('/other', refuse, 'no good')
    clock.now += QUIET_PERIOD
    guard.call('/speed', refuse, 'value again')
    assert said == [
        '/speed: message skipped: value 0',
        '/other: message skipped: no good',
        '/speed: message skipped: value again (49 more since)',
    ]
    assert guard.refused == {'/speed': 51, '/other': 1}
    assert guard.last['/speed'] == 'value again'


def test_a_fault_of_the_program_is_caught_and_told_as_an_error():
    warned, failed = [], []
    guard = Guard(Voice(Clock()), warned.append, failed.append)
    assert guard.call('/speed', lambda: 1 / 0) is False
    assert guard.call('/speed', lambda: None) is True
    assert not warned
    assert 'ZeroDivisionError' in failed[0]


def test_remarks_that_differ_in_numbers_only_are_one_thing():
    clock, said = Clock(), []
    voice = Voice(clock)
    for gap in (0.01, 0.02, -0.3):
        voice.say(f'gap of {gap} s', said.append)
    voice.say('clock set back', said.append)
    assert said == ['gap of 0.01 s', 'clock set back']


def test_what_a_voice_remembers_is_bounded():
    voice = Voice(Clock())
    for number in range(3000):
        voice.say('x', lambda text: None, thing=f'thing {number}')
    assert len(voice._said) <= 1002


# Latency


def test_latency_keeps_percentiles_and_the_worst_since_the_start():
    latency = Latency()
    assert latency.figures().blocks == 0
    latency.add(0, 500_000_000)
    for _ in range(5000):
        latency.add(1_000_000, 3_000_000)
    figures = latency.figures()
    assert figures.p50 == figures.p99 == pytest.approx(2e-3)
    assert figures.worst == pytest.approx(0.5)
    latency.add(10, 5)  # a clock that was set back
    assert latency.figures().worst == pytest.approx(0.5)


# Diagnostics


ACCELERATION, SPEED, GNSS = '/axle_box_acceleration', '/speed', '/gnss'
COACH = load_vehicle('measurement_coach')


def picture(**changes):
    health = Health(
        blocks=100, speed_messages=100, speed_state='ok', speed=20.0, position=5.0,
        sample_rate=25600.0, bad_samples={box.name: 0 for box in COACH.axle_boxes},
        missing_blocks={box.name: 0 for box in COACH.axle_boxes})
    own = {key: changes.pop(key) for key in list(changes) if hasattr(health, key)}
    return Picture(dataclasses.replace(health, **own), ACCELERATION, SPEED, GNSS,
                   {ACCELERATION: 1, SPEED: 1, GNSS: 'gnss' in str(changes)}, **changes)


def diagnosed(now, before=None, limits=None):
    before = before or picture(blocks=0, speed_messages=0)
    found = diagnostics.statuses(now, before, 1.0, COACH, 'node', limits or Limits())
    return {status.name.removeprefix('node: '): status for status in found}


def test_all_is_well():
    assert {status.level for status in diagnosed(picture()).values()} == {OK}
    assert len(diagnosed(picture())) == 5 + len(COACH.axle_boxes)


@pytest.mark.parametrize(('part', 'level', 'words', 'changes'), [
    ('acceleration', ERROR, 'no blocks on', {'blocks': 0}),
    ('acceleration', ERROR, 'cannot be used: field t', {
        'refused': {ACCELERATION: 3}, 'last_refusal': {ACCELERATION: 'field t'}}),
    ('acceleration', WARN, '4 blocks were lost', {'lost': 4}),
    ('acceleration', WARN, '2 blocks are repeated', {'stamps': Stamps(duplicates=2)}),
    ('acceleration', WARN, '3 blocks came out of order', {'stamps': Stamps(out_of_order=3)}),
    ('acceleration', ERROR, 'overload: 7 blocks were dropped', {'shed': 7}),
    ('acceleration', WARN, 'less than 30000 Hz', {'limits': {'sample_rate_limit': 30e3}}),
    ('clock', WARN, 'jumped by -3 s', {'stamps': Stamps(jumps=1, jump=-3.0)}),
    ('clock', WARN, 'set the position', {'clock_resets': 1}),
    ('clock', WARN, '100 s behind the clock', {'stamps': Stamps(offset=100.0)}),
    ('clock', WARN, '8 s ahead of the clock', {'stamps': Stamps(offset=-8.0)}),
    ('speed', WARN, 'publish the speed more often', {'limits': {'speed_rate_limit': 200.0}}),
    ('speed', WARN, 'slips or slides', {'speed_change': 9.0}),
    ('speed', WARN, 'differs by 30 %', {'gnss_difference': 0.3, 'gnss_speed': 26.0}),
    ('model', WARN, '70 % of the acceleration of axle2_left unexplained', {
        'residuals': {'axle2_left': {'100-400 Hz': 0.7}, 'axle2_right': {'100-400 Hz': 0.1}}}),
    ('model', OK, 'at most 10 %', {'residuals': {'axle2_right': {'100-400 Hz': 0.1}}}),
    ('load', WARN, '95 % of a processor core', {'load': 0.95}),
    ('gnss', WARN, 'the receiver has no fix', {
        'refused': {GNSS: 1}, 'last_refusal': {GNSS: 'status: the receiver has no fix'}}),
    ('acceleration', WARN, '1 gaps', {'gaps': 1}),
    ('speed', ERROR, 'nothing is estimated', {'speed_state': 'silent'}),
    ('speed', ERROR, 'no speed', {'speed_messages': 0}),
    ('speed', ERROR, 'no speed', {'blocks': 0, 'speed_overdue': True}),
    ('speed', ERROR, 'no speed', {'speed_state': 'none', 'speed_overdue': True}),
    ('speed', ERROR, 'not a plausible speed', {
        'refused_speeds': 1, 'last_refusal': {SPEED: 'of an earlier one'}}),
    ('speed', WARN, 'raise speed_delay', {'late_speeds': 1}),
    ('axle box axle1_left', ERROR, 'no channel axle1_left', {
        'dead': ('axle1_left',), 'missing_blocks': {'axle1_left': 5}}),
    ('axle box axle1_left', ERROR, 'check sensor', {
        'dead': ('axle1_left',), 'bad_samples': {'axle1_left': 256}}),
    ('axle box axle1_left', WARN, 'some samples', {'bad_samples': {'axle1_left': 1}}),
    ('axle box axle2_left', WARN, 'axle1_left on the same rail is dead', {'dead': ('axle1_left',)}),
    ('axle box axle1_right', OK, 'measuring', {'dead': ('axle1_left',)}),
    ('axle box axle1_left', ERROR, 'stuck', {'signals': {'axle1_left': Signal(256, 0, 0.0, 0.8)}}),
    ('axle box axle1_left', WARN, 'saturated', {'signals': {'axle1_left': Signal(256, 9, 0.0)}}),
    ('axle box axle1_left', ERROR, 'turn the sensor over', {'reversed': {'axle1_left': -0.8}}),
    ('axle box axle1_left', WARN, 'set input_includes_gravity', {
        'signals': {'axle1_left': Signal(256, 0, 9.7)}}),
    ('axle box axle1_left', WARN, 'upside down', {
        'signals': {'axle1_left': Signal(256, 0, -9.9)}, 'includes_gravity': True}),
    ('axle box axle1_left', WARN, 'does not report gravity', {
        'signals': {'axle1_left': Signal(256, 0, 0.1)}, 'includes_gravity': True}),
    ('axle box axle1_left', WARN, 'check its zero', {
        'signals': {'axle1_left': Signal(256, 0, 60.0)}}),
    ('axle box axle1_left', OK, 'measuring', {
        'signals': {'axle1_left': Signal(256, 0, 9.8)}, 'includes_gravity': True}),
])
def test_a_fault_is_named_with_what_to_do(part, level, words, changes):
    limits = Limits(**changes.pop('limits', {}))
    status = diagnosed(picture(**changes), limits=limits)[part]
    assert status.level == level
    assert words in status.message


def test_every_threshold_silences_its_warning():
    """A threshold of the same name as the fault that it judges, raised, turns WARN into OK."""
    raised = {
        'gap_limit': ('acceleration', {'gaps': 1}),
        'lost_limit': ('acceleration', {'lost': 1}),
        'duplicate_limit': ('acceleration', {'stamps': Stamps(duplicates=1)}),
        'out_of_order_limit': ('acceleration', {'stamps': Stamps(out_of_order=1)}),
        'clock_offset_limit': ('clock', {'stamps': Stamps(offset=7.0)}),
        'bad_sample_limit': ('axle box axle1_left', {
            'samples': 256, 'bad_samples': {'axle1_left': 1}}),
        'stuck_limit': ('axle box axle1_left', {'signals': {'axle1_left': Signal(9, 0, 0.0, 2.0)}}),
        'saturation_limit': ('axle box axle1_left', {'signals': {'axle1_left': Signal(9, 1, 0.0)}}),
        'offset_limit': ('axle box axle1_left', {'signals': {'axle1_left': Signal(9, 0, 9.0)}}),
        'slip_limit': ('speed', {'speed_change': 4.0}),
        'gnss_limit': ('speed', {'gnss_difference': 0.2}),
        'latency_limit': ('latency', {'latency': LatencyFigures(9, 0.1, 0.2, 0.3)}),
        'load_limit': ('load', {'load': 0.95}),
        'residual_limit': ('model', {'residuals': {'axle2_left': {'100-400 Hz': 0.7}}}),
    }
    for name, (part, changes) in raised.items():
        now = picture(**dict(changes))
        assert diagnosed(now)[part].level in (WARN, ERROR), name
        high = 1.0 if name.startswith(('bad', 'saturation')) else 50.0
        assert diagnosed(now, limits=Limits(**{name: high}))[part].level == OK, name


def test_all_that_is_wrong_is_named_the_worst_first():
    status = diagnosed(picture(lost=4, gaps=1, shed=2))['acceleration']
    assert status.level == ERROR
    assert status.message.index('overload') < status.message.index('lost')
    assert '1 gaps' in status.message


def test_a_missing_channel_is_still_told_as_such_when_the_blocks_have_stopped():
    gone = {'dead': ('axle1_left',), 'missing_blocks': {'axle1_left': 5}}
    status = diagnosed(picture(**gone), picture(**gone))['axle box axle1_left']
    assert 'no channel axle1_left' in status.message


def test_what_was_wrong_before_is_forgotten():
    before = picture(gaps=3, late_speeds=2, lost=7, blocks=100)
    now = picture(gaps=3, late_speeds=2, lost=7, blocks=200, speed_messages=200)
    assert {status.level for status in diagnosed(now, before).values()} == {OK}


@pytest.mark.parametrize(('interval', 'level'), [(1.0, OK), (1.7, WARN), (math.nan, OK)])
@pytest.mark.parametrize('messages', [0, 1, 2])
def test_seldom_speed_is_judged_alike_in_reports_with_and_without_a_message(
        interval, level, messages):
    """It is lost when the estimator says so: as long as the position moves on it is not."""
    before = picture(blocks=100, speed_messages=5)
    now = picture(blocks=200, speed_messages=5 + messages, speed_interval=interval)
    status = diagnosed(now, before)['speed']
    assert status.level == level
    assert 'nothing is estimated' not in status.message


def test_a_missing_publisher_is_told_apart_from_a_silent_one():
    now = dataclasses.replace(picture(blocks=0), publishers={})
    status = diagnosed(now)['acceleration']
    assert 'nobody publishes on /axle_box_acceleration' in status.message
    assert 'remap' in status.message


def test_a_high_latency_is_a_warning():
    latency = Latency()
    for _ in range(100):
        latency.add(0, 80_000_000)
    status = diagnosed(picture(latency=latency.figures()))['latency']
    assert status.level == WARN
    assert status.values['p99_ms'] == '80.000'


# Parameters


def test_the_shipped_parameter_file_is_the_declaration():
    assert (config_directory() / 'estimator.yaml').read_text() == parameter_file.text()


def test_the_shipped_parameter_file_holds_every_default_in_its_type():
    content = yaml.safe_load(parameter_file.text())['/**']['ros__parameters']
    assert set(content) == {item.name for item in SETTINGS}
    for item in SETTINGS:
        value = content[item.name]
        if isinstance(value, str) and EXPONENT_NUMBER.fullmatch(value):
            value = float(value)
        assert value == item.default
        assert type(value) is item.kind


def test_parameters_survive_the_command_line():
    values = {'a': "it's 5", 'b': True, 'c': 2.0, 'd': 3, 'e': ['x', 'y: z']}
    arguments = ros_parameters(values)
    read = dict(argument.split(':=', 1) for argument in arguments if ':=' in argument)
    assert {name: yaml.safe_load(text) for name, text in read.items()} == values


def test_a_setting_of_a_node_knows_its_kind():
    assert setting('x', 1.0, 'a number').kind is float
    assert setting('x', True, 'a switch').kind is bool


# Playback


@pytest.mark.parametrize('types', [LIVE, OFFLINE])
@pytest.mark.parametrize('shift', [0, 1, -1, 1_700_000_000 * SECOND, -3 * SECOND - 999_999_999])
def test_restamping_moves_the_stamp_and_nothing_else(types, shift):
    stamp = 10**9 + 5 * SECOND
    message = PointCloud2(header=encode_header(stamp, 'frame', LIVE), width=3, point_step=2)
    data = serialize_message(message)
    moved = deserialize_message(restamped(data, shift), PointCloud2)
    assert decode_stamp(moved) == stamp + shift
    moved.header = message.header
    assert moved == message


def test_an_endless_run_goes_on_without_a_gap_in_stamps():
    from railtrack_ros.bags.mcap_file import RawMessage
    from railtrack_ros.bags.writer import ACCELERATION_TOPIC, SPEED_TOPIC
    from railtrack_ros.node.virtual_vehicle import endless

    def message(topic, due, stamp):
        header = encode_header(stamp, '', LIVE)
        return RawMessage(topic, 'sensor_msgs/msg/PointCloud2', due,
                          serialize_message(PointCloud2(header=header)))

    run = [message(SPEED_TOPIC, due, due) for due in range(-2, 5)]
    run += [message(ACCELERATION_TOPIC, due, due - 1) for due in range(1, 5)]
    run.sort(key=lambda m: m.log_time)
    base = 10**9
    run = [m._replace(log_time=m.log_time + base, data=restamped(m.data, base)) for m in run]
    sent = list(itertools.islice(endless(run, 4), 60))
    for topic, first in ((SPEED_TOPIC, -2), (ACCELERATION_TOPIC, 1)):
        times = [m.log_time - base for m in sent if m.topic == topic]
        assert times == list(range(first, first + len(times)))
        stamps = [decode_stamp(deserialize_message(m.data, PointCloud2)) - base
                  for m in sent if m.topic == topic]
        assert stamps == [t - (topic == ACCELERATION_TOPIC) for t in times]


def test_reading_ahead_keeps_order_and_passes_errors_on():
    def items():
        yield from range(100)
        raise InputError('the file ends here')

    got = []
    with pytest.raises(InputError, match='ends here'):
        got.extend(ahead(items(), limit=5))
    assert list(ahead(range(1000), limit=3)) == list(range(1000))


def test_reading_ahead_stops_with_its_reader():
    fetched = []

    def items():
        for number in range(10**9):
            fetched.append(number)
            yield number

    stream = ahead(items(), limit=4)
    assert next(stream) == 0
    stream.close()  # waits for the thread
    count = len(fetched)
    assert count < 20
    time.sleep(0.05)
    assert len(fetched) == count
