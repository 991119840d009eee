"""What two live ROS 2 processes give over DDS is what the offline estimate of it gives."""

import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.writer import Recording
from railtrack_ros.node.demo import PATIENT_INPUTS
from railtrack_ros.node.processes import Domain, Processes, ros_parameters, transport
from railtrack_ros.node.recorder import Recorder
from railtrack_ros.paths import share_directory
from railtrack_ros.runs.estimate import NODE, estimate
from railtrack_ros.runs.results import WAVEFORMS
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

BAGS = share_directory() / 'bags'
DEADLINE = 90.0  # s


def record(sample, output, folder, parameters):
    domain = Domain()
    environment = {**domain.environment(folder), **transport()}
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain.number,
               signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('test', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    deadline = time.monotonic() + DEADLINE

    def spin_until(condition):
        while not condition():
            assert time.monotonic() < deadline, 'nothing came of it in time'
            executor.spin_once(timeout_sec=0.05)

    ready = []
    try:
        with Processes(environment, folder) as processes, Recording(output) as recording:
            estimator = processes.start(
                'track_estimator', 'railtrack_ros.node.track_estimator',
                ros_parameters(parameters), lambda severity, text: ready.append(text))
            recorder = Recorder(node, recording)
            spin_until(lambda: any(text.startswith('ready') for text in ready))
            spin_until(lambda: recorder.matched(f'{NODE}/irregularity'))
            vehicle = processes.start(
                'virtual_vehicle', 'railtrack_ros.node.virtual_vehicle',
                ros_parameters({'recording': str(sample), 'subscribers': 2}))
            spin_until(lambda: vehicle.status is not None)
            assert vehicle.status == 0, vehicle.tail()
            sent = recorder.received['/axle_box_acceleration']
            spin_until(lambda: recorder.received[f'{NODE}/irregularity'] == sent)
            end = time.monotonic() + 1.0
            spin_until(lambda: time.monotonic() > end)
            assert estimator.stop() == 0
            assert recorder.lost.total() == 0
            # Fast DDS reads config/fastdds.xml and would complain here.
            assert 'XMLPARSER' not in estimator.log_file.read_text()
    finally:
        node.destroy_node()
        context.try_shutdown()
        domain.close()


def messages(path, topic):
    """Return the messages of a topic in one encoding, without what differs by nature."""
    with open_bag(path) as bag:
        decoded = [bag.decode(message) for message in bag.messages({topic})]
    return [OFFLINE.serialize(message) for message in decoded]


def test_every_result_is_equal_to_the_last_bit_and_not_one_block_is_lost(tmp_path):
    sample = BAGS / 'braking_wheelset.mcap'  # both rails, and a speed that changes
    live, offline = tmp_path / 'live.mcap', tmp_path / 'offline.mcap'
    with open_bag(sample) as bag:
        track, start = bag.facts['track'], float(bag.facts['start_position'])
        vehicle = BAGS / f'{bag.facts["vehicle"]}.yaml'
    record(sample, live, tmp_path, {
        'track': track, 'vehicle': str(vehicle), 'start_position': start, **PATIENT_INPUTS})
    estimate(live, load_track(track), load_vehicle(vehicle), offline, start_position=start)

    with open_bag(live) as bag:
        counts = {name: topic.count for name, topic in bag.topics.items()}
    assert counts['/axle_box_acceleration'] == 300
    for topic in WAVEFORMS:
        assert counts[f'{NODE}/{topic}'] == 300
        assert messages(live, f'{NODE}/{topic}') == messages(offline, f'{NODE}/{topic}')

    summaries = [topic for topic in counts if topic.startswith(f'{NODE}/wheel/')]
    assert any('rms_30_100' in topic for topic in summaries)
    for topic in [*summaries, f'{NODE}/corrugation']:
        first, second = messages(live, topic), messages(offline, topic)
        # At the end of a recording the offline estimate also sums up the sections under way.
        assert first == second[:len(first)], topic

    # The live recording tells what it was computed with, as the offline one does.
    topic = f'{NODE}/configuration'
    assert messages(live, topic)[0] == messages(offline, topic)[0]
