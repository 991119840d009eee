"""The live nodes: real ones over DDS on the loopback interface, in a domain of their own."""

import array
import copy
import random
import struct
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, WrenchStamped
from nav_msgs.msg import Odometry
from node_bench import (
    BOX,
    RATE,
    RELIABLE,
    SAMPLES,
    START_NS,
    TRACK,
    VEHICLE,
    Bench,
    context_in,
    speed_stamp,
)
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, WaveformBlock, decode_waveform
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.node.processes import Domain
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle


@pytest.fixture(scope='module', autouse=True)
def domain():
    """A domain that no other test and no other program uses."""
    found = Domain()
    yield found.number
    found.close()


@pytest.fixture
def bench(domain):
    with context_in(domain) as context:
        found = Bench(context)
        try:
            yield found
        finally:
            found.close()


# What comes out


def test_every_block_is_answered_as_the_estimator_alone_would(bench):
    bench.start()
    bench.run(60)
    bench.spin_until(lambda: all(len(m) == 60 for m in bench.received.values()))

    alone = Estimator(load_track(TRACK), load_vehicle(VEHICLE), EstimatorSettings())
    for index in range(60):
        alone.add_speed(speed_stamp(index), 30.0)
        sent = decode_waveform(bench.block(index))
        expected = alone.process(sent.stamp_ns, sent.t, sent.channels)
        for name, messages in bench.received.items():
            got = decode_waveform(messages[index])
            wanted = getattr(expected, name.rsplit('/', 1)[-1])[BOX].astype(np.float32)
            np.testing.assert_array_equal(got.channels[BOX], wanted)
            np.testing.assert_array_equal(got.position, expected.position)
            assert (got.stamp_ns, got.frame_id) == (sent.stamp_ns, 'base_link')
    assert np.isfinite(wanted).all()


def test_speed_that_has_arrived_is_used_before_any_block_however_long_nobody_looked(bench):
    """100 speed messages a block: taken in turns, blocks would overtake them."""
    bench.start()
    for index in range(-10, 400):
        bench.send_speed(START_NS + index * SECOND // 400, 20.0 + 0.01 * index)
    for index in range(80):
        bench.acceleration.publish(bench.block(index))
        if index % 20 == 0:
            time.sleep(0.1)
    bench.spin_until(lambda: len(bench.forces()) == 80)
    health = bench.estimator._estimator.health
    assert health.late_speeds == 0
    assert bench.forces()[-1].position[-1] == pytest.approx(0.8 * 20.0 + 4.0 * 0.8**2 / 2, rel=0.01)


def test_summaries_indicators_and_configuration_are_published(bench):
    bench.start()
    peaks = bench.listen(WrenchStamped, f'/track_estimator/wheel/{BOX}/contact_force')
    sections = bench.listen(DiagnosticArray, '/track_estimator/corrugation')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    described = bench.listen(String, '/track_estimator/configuration', latched)
    bench.spin_until(lambda: described)  # it was said before anybody listened
    assert VEHICLE in described[0].data
    waves = 20.0 * np.sin(2 * np.pi * 400.0 * np.arange(SAMPLES) / RATE)
    for _ in range(12):
        bench.run(10, speed=40.0, values=waves)
        bench.spin_until(lambda: len(bench.forces()) == bench.blocks)
    bench.spin_until(lambda: peaks and sections)
    assert peaks[-1].wrench.force.z > 100e3
    status = sections[0].status[0]
    values = {pair.key: pair.value for pair in status.values}
    assert values['axle_box'] == BOX
    assert float(values['to_m']) - float(values['from_m']) == 10.0
    assert float(values['rms_30_100_um']) > 0.0


def test_a_kilometre_post_sets_the_position(bench):
    bench.start()
    setter = bench.client.create_publisher(PointStamped, '/track_estimator/set_position', RELIABLE)
    bench.connect(setter)
    bench.run(20)
    bench.spin_until(lambda: len(bench.forces()) == 20)
    setter.publish(codec.encode_position(START_NS + SECOND // 10, 5000.0, 'base_link', LIVE))
    bench.spin_until(lambda: bench.estimator._estimator._odometer._references)
    bench.run(20)
    bench.spin_until(lambda: len(bench.forces()) == 40)
    last = bench.forces()[-1]
    run = (last.stamp_ns - START_NS) / SECOND - 0.1 + last.t[-1]
    assert last.position[-1] == pytest.approx(5000.0 + 30.0 * run, abs=0.01)


def test_the_speed_may_come_as_odometry(domain):
    with context_in(domain) as context:
        bench = Bench(context, speed_type=codec.ODOMETRY)
        try:
            bench.start()
            for index in range(10):
                message = Odometry(header=codec.encode_header(speed_stamp(index), 'odom', LIVE))
                message.twist.twist.linear.x = 30.0
                bench.speed.publish(message)
                bench.acceleration.publish(bench.block(index))
            bench.spin_until(lambda: len(bench.forces()) == 10)
            assert bench.forces()[-1].position[-1] == pytest.approx(30.0 * 0.1, rel=0.01)
        finally:
            bench.close()


# Bad input


def adversarial(bench, count):
    """Yield bytes that are no good block: random damage, and lies with a method."""
    rng = random.Random(7)
    good = serialize_message(bench.block(10**6))

    def changed(**fields):
        message = bench.block(10**6)
        for name, value in fields.items():
            setattr(message, name, value)
        return serialize_message(message)

    cases = [
        b'', good[:4], good[:40], b'\xff' * 60,
        changed(width=0), changed(width=2**31), changed(width=SAMPLES + 1), changed(height=2),
        changed(height=0), changed(point_step=0), changed(point_step=2**32 - 1),
        changed(row_step=7), changed(data=array.array('B')), changed(fields=[]),
        changed(data=array.array('B', bytes(17))), changed(is_bigendian=True),
    ]
    for name, value in (('datatype', 2), ('datatype', 99), ('count', 0), ('count', 2**31),
                        ('offset', 2**31), ('offset', 3), ('name', ''), ('name', 't')):
        message = copy.deepcopy(bench.block(10**6))  # messages share the fields
        setattr(message.fields[1], name, value)
        cases.append(serialize_message(message))
    for values in ([np.nan] * SAMPLES, [np.inf] * SAMPLES, [3e38] * SAMPLES):
        message = copy.deepcopy(bench.block(10**6, values))
        message.fields[0].name = 'time'
        cases.append(serialize_message(message))
    for t in (np.full(SAMPLES, np.nan), np.full(SAMPLES, np.inf), np.zeros(SAMPLES),
              -np.arange(SAMPLES) / RATE, np.arange(SAMPLES) * 1e9, np.arange(SAMPLES) ** 2.0):
        cases.append(serialize_message(codec.encode_waveform(
            WaveformBlock(START_NS, t, {BOX: np.zeros(SAMPLES, np.float32)}), LIVE)))
    for nanoseconds in (2**32 - 1, 10**9):
        data = bytearray(good)
        struct.pack_into('<I', data, 8, nanoseconds)
        cases.append(bytes(data))
    while len(cases) < count:
        data = bytearray(good)
        for _ in range(rng.randrange(1, 5)):
            # In the header and the description of the fields, where the lies hurt.
            data[rng.randrange(12, 120)] = rng.choice([0, 1, 127, 128, 255, rng.randrange(256)])
        cases.append(bytes(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data))
    return cases


def test_two_thousand_malformed_messages_do_it_no_harm(bench):
    bench.start()
    logged = []
    bench.estimator._guard._warn = logged.append
    bench.run(30)
    bench.spin_until(lambda: len(bench.forces()) == 30)
    healthy = bench.estimator._estimator.health.blocks
    cases = adversarial(bench, 2000)
    inputs = bench.estimator._blocks[0], bench.estimator._speed
    before = [source.received for source in inputs]
    for begin in range(0, len(cases), 40):
        part = cases[begin:begin + 40]
        for data in part:
            bench.acceleration.publish(data)
            bench.speed.publish(data)
        # Without bytes there is no message, which is the first case.
        sent = begin + len(part) - 1
        bench.spin_until(lambda sent=sent: all(
            source.received >= count + sent
            for source, count in zip(inputs, before, strict=True)))
    topic = '/axle_box_acceleration'
    refused = bench.estimator._guard.refused
    bench.spin_until(lambda: refused[topic] + bench.estimator._estimator.health.blocks
                     + bench.estimator._estimator.health.dropped_blocks - healthy >= len(cases) - 1)
    assert refused[topic] > 1000
    assert refused['/speed'] > 50  # many bytes make a speed of some sort
    # Told at once, by name, and then only from time to time.
    assert any(line.startswith(f'{topic}: message skipped') for line in logged)
    assert len(logged) < 10

    answered = len(bench.forces())
    bench.run(5)
    bench.spin_until(lambda: any(
        f.stamp_ns == START_NS + 34 * SECOND // 100 for f in bench.forces()[answered:]))


def test_a_block_of_nan_marks_its_own_results_only(bench):
    bench.start()
    bench.run(60)
    bench.run(1, values=np.full(SAMPLES, np.nan))
    bench.spin_until(lambda: len(bench.forces()) == 61)
    bench.run(60)
    bench.spin_until(lambda: len(bench.forces()) == 121)
    forces = [f.channels[BOX] for f in bench.forces()]
    assert np.isfinite(forces[59]).all()
    assert np.isnan(forces[60]).all()
    assert np.isfinite(forces[-1]).all()
    assert not bench.received['/track_estimator/contact_force'][60].is_dense


def test_a_standing_vehicle_has_a_position_and_no_irregularity(bench):
    bench.start()
    bench.run(40, speed=0.0)
    bench.spin_until(lambda: all(len(m) == 40 for m in bench.received.values()))
    last = decode_waveform(bench.received['/track_estimator/irregularity'][-1])
    assert np.isnan(last.channels[BOX]).all()
    assert (last.position == 0.0).all()


# Diagnostics


def test_diagnostics_say_what_is_missing_and_what_to_do(bench):
    bench.start()
    diagnosed = bench.listen(DiagnosticArray, '/diagnostics')

    def status(part):
        found = {s.name: s for s in diagnosed[-1].status}
        return found[f'track_estimator: {part}']

    bench.spin_until(lambda: diagnosed)
    assert status('acceleration').level == b'\x02'
    assert 'no blocks on /axle_box_acceleration' in status('acceleration').message
    diagnosed.clear()

    def measured_throughout():
        """Send a block, and tell whether there were some in all of the last period."""
        bench.run(1)
        bench.spin_until(lambda: len(bench.forces()) == bench.blocks)
        return len(diagnosed) > 2

    bench.spin_until(measured_throughout)
    for part in ('acceleration', 'speed'):
        assert status(part).level == b'\x00', status(part).message
    values = {pair.key: pair.value for pair in status('latency').values}
    assert float(values['p99_ms']) >= float(values['p50_ms']) > 0.0
    assert status(f'axle box {BOX}').message == 'measuring'


# Parameters


def test_every_parameter_has_a_description_and_is_read(bench):
    from railtrack_ros.node.track_estimator import SETTINGS

    for setting in SETTINGS:
        descriptor: ParameterDescriptor = bench.estimator.describe_parameter(setting.name)
        assert len(descriptor.description) > 10
        if setting.unit:
            assert f'[{setting.unit}]' in descriptor.description
        assert bench.estimator.has_parameter(setting.name)


def test_settings_reach_the_estimator(domain):
    with context_in(domain) as context:
        bench = Bench(context, cut_on_wavelength=2.0, section_length=25.0, start_position=120.0)
        try:
            bench.start()
            assert bench.estimator._estimator.settings.cut_on_wavelength == 2.0
            assert bench.estimator._results._indicators.settings.section_length == 25.0
            bench.run(5)
            bench.spin_until(lambda: len(bench.forces()) == 5)
            assert bench.forces()[0].position[0] == 120.0
        finally:
            bench.close()


def test_nothing_is_computed_for_the_first_block_at_the_sample_rate_it_was_configured_for(
        domain, monkeypatch, tmp_path):
    from railtrack_ros.dynamics import recursive

    computed = []
    compute = recursive._compliances
    monkeypatch.setattr(recursive, '_compliances',
                        lambda *given: computed.append(given[1]) or compute(*given))
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))  # nothing there from earlier runs
    with context_in(domain) as context:
        bench = Bench(context, sample_rate=RATE)
        try:
            bench.start()
            prepared = list(computed)
            assert prepared == [1.0 / RATE]
            bench.run(2)
            bench.spin_until(lambda: len(bench.forces()) == 2)
            assert computed == prepared
        finally:
            bench.close()


def test_an_unknown_parameter_is_told_by_name(domain):
    from railtrack_ros.node import parameters

    with context_in(domain) as context:
        bench = Bench(context, cut_on_wavelenght=2.0)
        try:
            [sentence] = parameters.unknown(bench.estimator)
            assert 'cut_on_wavelenght is unknown' in sentence
            assert "'cut_on_wavelength'" in sentence
        finally:
            bench.close()


@pytest.mark.parametrize(('name', 'value', 'words'), [
    ('cut_on_wavelength', 2, 'a number with a decimal point'),
    ('cut_on_wavelength', -2.0, 'at least 0.1'),
    ('minimum_valid', 0.0, 'above 0'),
    ('local_system', 'magic', 'one of none, static, dynamic'),
    ('track', 3, 'text'),
])
def test_a_wrong_parameter_ends_the_start_with_a_sentence(domain, name, value, words):
    with context_in(domain) as context, pytest.raises(InputError, match=words) as error:
        Bench(context, **{name: value})
    assert name in str(error.value)


def test_a_change_that_could_not_take_effect_is_refused(bench):
    bench.start()

    def change(name, value):
        return bench.estimator.set_parameters([Parameter(name, value=value)])[0]

    refused = change('cut_on_wavelength', 2.0)
    assert not refused.successful
    assert 'deactivate' in refused.reason
    assert not change('latency_limit', -1.0).successful
    assert change('latency_limit', 0.1).successful
    # A file with all parameters may be loaded: what stays as it is is no change.
    assert change('cut_on_wavelength', 3.0).successful
    bench.estimator.trigger_deactivate()
    bench.estimator.trigger_cleanup()
    assert change('cut_on_wavelength', 2.0).successful


# Lifecycle


def test_it_can_be_deactivated_and_activated_and_configured_again(bench):
    bench.start()
    bench.run(10)
    bench.spin_until(lambda: len(bench.forces()) == 10)
    bench.estimator.trigger_deactivate()
    bench.spin_until(lambda: not bench.acceleration.get_subscription_count()
                     and not bench.speed.get_subscription_count())
    bench.run(10)
    bench.spin(0.5)
    assert len(bench.forces()) == 10
    bench.estimator.trigger_activate()
    bench.connect(bench.acceleration, bench.speed)
    bench.run(10)
    bench.spin_until(lambda: len(bench.forces()) == 20)
    for transition in ('deactivate', 'cleanup', 'configure', 'activate'):
        result = getattr(bench.estimator, f'trigger_{transition}')()
        assert result == TransitionCallbackReturn.SUCCESS


def test_an_unknown_track_fails_to_configure_and_can_be_corrected(domain):
    with context_in(domain) as context:
        bench = Bench(context, track='nowhere')
        try:
            assert bench.estimator.trigger_configure() == TransitionCallbackReturn.FAILURE
            assert "unknown track 'nowhere'" in bench.estimator.failure
            bench.estimator.set_parameters([Parameter('track', value=TRACK)])
            assert bench.estimator.trigger_configure() == TransitionCallbackReturn.SUCCESS
        finally:
            bench.close()
