"""Other inputs of the live estimator: single samples, GNSS, several vehicles, too much at once."""

import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelStamped, PointStamped
from node_bench import BOX, RELIABLE, START_NS, Bench, context_in, speed_stamp
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu, NavSatFix

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, decode_position
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.node.processes import Domain


@pytest.fixture(scope='module')
def domain():
    found = Domain()
    yield found.number
    found.close()


@pytest.fixture
def make_bench(domain):
    """Return a function that makes benches; all of them are closed at the end."""
    benches = []
    with context_in(domain) as context:
        def make(**options):
            benches.append(Bench(context, **options))
            return benches[-1]

        try:
            yield make
        finally:
            for bench in benches:
                bench.close()


def sample(kind, stamp_ns, value):
    message = kind(header=codec.encode_header(stamp_ns, 'sensor', LIVE))
    vector = message.linear_acceleration if kind is Imu else message.accel.linear
    vector.z = float(value)
    return message


@pytest.mark.parametrize('kind', [Imu, AccelStamped])
def test_single_samples_are_estimated_as_blocks(make_bench, kind):
    bench = make_bench(
        acceleration_type=codec.IMU if kind is Imu else codec.ACCELERATION,
        input_includes_gravity=True)
    bench.start()
    for index in range(1500):
        stamp_ns = START_NS + index * SECOND // 1000
        if index % 10 == 0:
            bench.send_speed(stamp_ns - SECOND // 50, 20.0)
        wave = 5.0 * np.sin(2 * np.pi * 100.0 * index / 1000.0)
        bench.acceleration.publish(sample(kind, stamp_ns, wave + 9.80665))
        if index % 100 == 0:
            bench.spin(0.05)
    bench.spin_until(lambda: len(bench.forces()) == 30)
    last = bench.forces()[-1]
    assert last.samples == 50
    assert np.isfinite(last.channels[BOX]).all()
    # Static load and mass times acceleration.
    vehicle = bench.estimator._vehicle
    swing = np.ptp(last.channels[BOX]) / 2
    assert swing == pytest.approx(5.0 * vehicle.wheel.mass, rel=0.05)
    assert last.channels[BOX].mean() == pytest.approx(vehicle.wheel.static_load, rel=0.01)


def test_topics_are_named_by_parameters(make_bench):
    bench = make_bench(acceleration_topic='sensors/vibration', speed_topic='/odometer').start()
    bench.run(5)
    bench.spin_until(lambda: len(bench.forces()) == 5)
    names = dict(bench.client.get_topic_names_and_types())
    assert {'/sensors/vibration', '/odometer'} <= set(names)
    assert '/axle_box_acceleration' not in names


def test_vehicles_in_namespaces_do_not_hear_each_other(make_bench):
    first, second = (make_bench(namespace=name).start() for name in ('coach1', 'coach2'))
    first.run(5)
    second.run(3, speed=10.0)
    first.spin_until(lambda: len(first.forces()) == 5)
    second.spin_until(lambda: len(second.forces()) == 3)
    assert second.node_name == '/coach2/track_estimator'
    diagnosed = first.listen(DiagnosticArray, '/diagnostics')

    def who():
        return {status.name.split(':')[0] for message in diagnosed for status in message.status}

    end = time.monotonic() + 20.0
    while len(who()) < 2:
        assert time.monotonic() < end
        first.spin(0.05)
        second.spin(0.05)
    assert who() == {'coach1/track_estimator', 'coach2/track_estimator'}


def test_fixes_are_written_with_their_track_positions(make_bench, tmp_path):
    table = tmp_path / 'map.csv'
    bench = make_bench(gnss_table=str(table), start_position=1000.0).start()
    positions = bench.listen(PointStamped, '/track_estimator/position')
    receiver = bench.client.create_publisher(NavSatFix, 'gnss', RELIABLE)
    bench.connect(receiver)
    for index in range(100):
        if index % 20 == 0:
            fix = NavSatFix(latitude=48.0 + 1e-5 * index, longitude=11.0, altitude=500.0)
            fix.header = codec.encode_header(START_NS + index * SECOND // 100, 'aerial', LIVE)
            fix.status.status = 0 if index != 60 else -1
            receiver.publish(fix)
        bench.run(1)
        if index % 10 == 0:
            bench.spin(0.02)
    bench.spin_until(lambda: len(bench.forces()) == 100)
    lines = table.read_text().splitlines()
    assert lines[0].startswith('time_s,position_m,speed_m_s,latitude_deg')
    rows = [[float(word or 'nan') for word in line.split(',')] for line in lines[1:]]
    # The first fix is older than the first position, the fourth is none.
    assert [round(row[3], 5) for row in rows] == [48.0002, 48.0004, 48.0008]
    assert rows[0][1] == pytest.approx(1000.0 + 0.2 * 30.0, abs=0.1)
    assert bench.estimator._guard.last['/gnss'].endswith('no fix')
    stamp_ns, position = decode_position(positions[-1])
    assert position == pytest.approx(1000.0 + 30.0 * (stamp_ns - START_NS) / SECOND, abs=0.1)
    assert len(positions) == 10


def wait_at_most(bench, seconds):
    bench.estimator.set_parameters([Parameter('shed_delay', value=seconds)])
    bench.estimator._adopt_limits()


def test_overload_drops_all_that_waits_says_so_and_goes_on_with_the_next(make_bench):
    bench = make_bench().start()
    diagnosed = bench.listen(DiagnosticArray, '/diagnostics')
    bench.run(20)
    bench.spin_until(lambda: len(bench.forces()) == 20)
    wait_at_most(bench, 0.3)
    bench.run(30)
    time.sleep(0.5)  # nobody looks after them
    bench.spin_until(lambda: bench.estimator._shed)
    bench.spin(0.3)
    assert len(bench.forces()) == 20
    wait_at_most(bench, 600.0)
    bench.run(40)
    bench.spin_until(lambda: len(bench.forces()) == 60)
    stamps = [force.stamp_ns for force in bench.forces()]
    assert stamps[20:] == [START_NS + index * SECOND // 100 for index in range(50, 90)]
    assert np.isfinite(bench.forces()[-1].channels[BOX]).all()

    def overload():
        return [status for message in diagnosed for status in message.status
                if 'overload:' in status.message]

    bench.spin_until(overload)
    assert overload()[0].level == b'\x02'
    assert bench.estimator._picture().shed == 30


def test_thresholds_may_change_while_it_runs(make_bench):
    bench = make_bench().start()
    node = bench.estimator
    for name, value in (('latency_limit', 0.2), ('full_scale', 500.0), ('shed_delay', 2.0)):
        assert node.set_parameters([Parameter(name, value=value)])[0].successful
    node._diagnose()
    assert node._limits.latency_limit == 0.2
    assert node._watch.full_scale == 500.0
    assert node._shed_delay == 2.0


def test_a_speed_that_no_train_reaches_is_refused_and_is_no_slip(make_bench):
    bench = make_bench().start()
    bench.run(60)
    bench.spin_until(lambda: len(bench.forces()) == 60)
    bench.send_speed(speed_stamp(60), 1e9)
    bench.spin_until(lambda: bench.estimator._estimator.health.refused_speeds == 1)
    assert bench.estimator._speed_watch.take() < 0.1


def test_garbage_on_the_other_inputs_does_no_harm(make_bench):
    bench = make_bench().start()
    fix = bench.client.create_publisher(NavSatFix, 'gnss', RELIABLE)
    place = bench.client.create_publisher(PointStamped, '/track_estimator/set_position', RELIABLE)
    bench.connect(fix, place)
    bench.run(10)
    for value in (np.nan, np.inf, -np.inf, 1e300, -1e9, 91.0):
        fix.publish(NavSatFix(latitude=value, longitude=value))
        message = PointStamped()
        message.point.x = value
        place.publish(message)
        for publisher in (fix, place):
            publisher.publish(b'')
            publisher.publish(b'\0\1\0\0' + bytes(range(40)))
    refused = bench.estimator._guard.refused
    bench.spin_until(lambda: refused['/gnss'] >= 8
                     and refused['/track_estimator/set_position'] >= 4)
    bench.run(10)
    bench.spin_until(lambda: len(bench.forces()) == 20)
    assert bench.forces()[-1].position[-1] == pytest.approx(30.0 * 0.2, abs=0.1)
    assert refused['/gnss'] >= 8
    assert refused['/track_estimator/set_position'] >= 4
