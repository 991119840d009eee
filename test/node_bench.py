"""A live estimator and a client that feeds it, in one process and a domain of their own."""

import time
from contextlib import contextmanager

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, WaveformBlock, decode_waveform
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.node.track_estimator import TrackEstimator

TRACK = VEHICLE = 'blanco_table_3_1'
BOX = 'axle1_left'
RATE = 12800.0
SAMPLES = 128
START_NS = 1_000 * SECOND
DEADLINE = 120.0  # s; nothing takes so long unless it never comes
RELIABLE = QoSProfile(depth=1000)


@contextmanager
def context_in(domain):
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain,
               signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield context
    finally:
        context.try_shutdown()


def speed_stamp(index):
    """Return the time of the speed sent with block `index`: 20 ms before its beginning."""
    return START_NS + (index - 2) * SECOND // 100


class Bench:
    """A track estimator, and a client that feeds it and listens to it."""

    def __init__(self, context, namespace='', **parameters):
        # However busy the machine is, nothing is dropped unless a test wants it.
        overrides = {'track': TRACK, 'vehicle': VEHICLE, 'shed_delay': 600.0, **parameters}
        self.estimator = TrackEstimator(
            context=context, namespace=namespace,
            parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()])
        self.client = rclpy.create_node('client', context=context, namespace=namespace)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.estimator)
        self.executor.add_node(self.client)
        self.node_name = self.estimator.get_fully_qualified_name()
        topic = parameters.get('acceleration_topic', 'axle_box_acceleration')
        kind = LIVE.get(parameters.get('acceleration_type', codec.WAVEFORM))
        single = '' if kind is PointCloud2 else f'/{BOX}'
        self.acceleration = self.client.create_publisher(kind, f'{topic}{single}', RELIABLE)
        speed_type = LIVE.get(parameters.get('speed_type', codec.TWIST))
        self.speed = self.client.create_publisher(
            speed_type, parameters.get('speed_topic', 'speed'), RELIABLE)
        self.received = {}
        self.blocks = 0

    def start(self):
        assert self.estimator.trigger_configure() == TransitionCallbackReturn.SUCCESS
        assert self.estimator.trigger_activate() == TransitionCallbackReturn.SUCCESS
        self.connect(self.acceleration, self.speed)
        for name in ('contact_force', 'rail_deflection', 'irregularity'):
            self.listen(PointCloud2, f'{self.node_name}/{name}')
        return self

    def connect(self, *publishers):
        """Wait until the inputs of the estimator and these publishers know of each other.

        Either side alone may be ahead, and what is sent meanwhile is lost.
        """
        def known(publisher):
            return publisher.get_subscription_count() and all(
                source.publishers for source in self.estimator._inputs
                if source.topic == publisher.topic_name)

        self.spin_until(lambda: all(known(publisher) for publisher in publishers))

    def listen(self, kind, topic, qos=RELIABLE):
        """Return the list of the messages that come on a topic from now on."""
        messages = self.received.setdefault(topic, [])
        subscription = self.client.create_subscription(kind, topic, messages.append, qos)
        readers = sum(s.topic_name == subscription.topic_name for s in self.client.subscriptions)
        writers = [p for p in self.estimator.publishers if p.topic_name == subscription.topic_name]
        self.spin_until(lambda: subscription.get_publisher_count() > 0 and all(
            writer.get_subscription_count() >= readers for writer in writers))
        return messages

    def spin_until(self, condition):
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, 'nothing came of it in time'
            self.executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def close(self):
        self.estimator.destroy_node()
        self.client.destroy_node()

    # Feeding

    def send_speed(self, stamp_ns, speed):
        self.speed.publish(codec.encode_speed(stamp_ns, speed, 'base_link', LIVE))

    def block(self, index, values=None):
        """Return the message of block number `index`."""
        t = np.arange(SAMPLES) / RATE
        if values is None:
            values = 5.0 * np.sin(2 * np.pi * 400.0 * (t + index * SAMPLES / RATE))
        stamp_ns = START_NS + index * SECOND // 100
        return codec.encode_waveform(
            WaveformBlock(stamp_ns, t, {BOX: np.asarray(values, np.float32)}, None, 'base_link'),
            LIVE)

    def run(self, blocks, speed=30.0, values=None):
        """Send so many further blocks with the speed that belongs to them."""
        for index in range(self.blocks, self.blocks + blocks):
            self.send_speed(speed_stamp(index), speed)
            self.acceleration.publish(self.block(index, values))
        self.blocks += blocks

    def forces(self):
        return [decode_waveform(m) for m in self.received[f'{self.node_name}/contact_force']]
