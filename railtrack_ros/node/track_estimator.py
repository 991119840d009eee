"""Node `track_estimator`: acceleration and speed in, force, deflection and irregularity out.

A lifecycle node without any mechanics: it decodes messages, calls the estimator, and publishes.
Configuring computes the model, activating subscribes; with the parameter `autostart` it does
both by itself.
"""

from __future__ import annotations

import copy
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import (
    LifecycleNode,
    LifecyclePublisher,
    LifecycleState,
    TransitionCallbackReturn,
)
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from railtrack_ros.bags import codec
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings, declared
from railtrack_ros.node import diagnostics, parameters
from railtrack_ros.node.diagnostics import Picture
from railtrack_ros.node.guard import Guard, Voice
from railtrack_ros.node.latency import Latency
from railtrack_ros.node.parameters import setting
from railtrack_ros.node.qos import LATCHED, RESULT, SENSOR_INPUT, overridable
from railtrack_ros.node.runner import run
from railtrack_ros.parameters import POSITIVE
from railtrack_ros.runs import configuration
from railtrack_ros.runs.results import CONFIGURATION, WAVEFORMS, ResultMessages
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import Vehicle, load_vehicle

NAME = 'track_estimator'
DIAGNOSTICS = 'diagnostics'

DIAGNOSTICS_PERIOD = 1.0  # s
# Sample rate at which the compiled code is tried out before the first block, Hz.
TRIAL_RATE = 25600.0

OWN_SETTINGS = (
    setting('autostart', True, 'configure and activate at the start; false: wait to be told'),
    setting('track', 'mainline_soft_pads', 'shipped track or path of a YAML file'),
    setting('vehicle', 'measurement_coach', 'shipped vehicle or path of a YAML file'),
    setting('frame_id', 'base_link', "the vehicle's frame, in the header of the results"),
    setting('speed_type', codec.TWIST, 'message type of the speed', '',
            choices=(codec.TWIST, codec.ODOMETRY)),
    setting('latency_limit', 0.05, 'a longer delay of 1 % of the results is a warning', 's',
            POSITIVE),
)
SETTINGS = (*OWN_SETTINGS, *declared(EstimatorSettings), *declared(IndicatorSettings))
# May change at any time; everything else is taken up when the node is configured.
CHANGEABLE = ('latency_limit',)


class TrackEstimator(LifecycleNode):
    """The estimator on ROS 2 topics.

    Attributes
    ----------
    failure
        Why the last transition failed, empty if it did not.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(NAME, **options)
        parameters.declare(self, SETTINGS, fixed=('autostart',))
        for sentence in parameters.unknown(self):
            self.get_logger().warning(sentence)
        self.add_on_set_parameters_callback(self._check_change)
        self.failure = ''
        self._configured = False
        self._publishers_by_topic: dict[str, LifecyclePublisher] = {}
        self._inputs: dict[str, Subscription] = {}
        self._timer: Timer | None = None
        self._voice = Voice()

    @property
    def autostart(self) -> bool:
        """Whether the node configures and activates itself."""
        return bool(self.get_parameter('autostart').value)

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, compute the model of the track and offer the results."""
        return self._attempt('configure', self._configure, self._release)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe to the inputs."""
        result = self._attempt('activate', self._subscribe, self._unsubscribe)
        if result == TransitionCallbackReturn.SUCCESS:
            super().on_activate(state)
            self._publish(CONFIGURATION, self._configuration)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Leave the inputs; the model stays."""
        self._unsubscribe()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give everything back."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End, from any state."""
        self._unsubscribe()
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to the unconfigured state after a failed transition."""
        self._unsubscribe()
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _attempt(self, what: str, work: Callable[[], None], undo: Callable[[], None]
                 ) -> TransitionCallbackReturn:
        """Do the work of a transition; say why it failed, which rclpy would keep to itself."""
        self.failure = ''
        try:
            work()
            return TransitionCallbackReturn.SUCCESS
        except InputError as error:
            self.failure = str(error)
        except Exception as error:
            self.failure = f'unexpected {error!r}'
        self.get_logger().error(f'cannot {what}: {self.failure}')
        undo()
        return TransitionCallbackReturn.FAILURE

    def _configure(self) -> None:
        begun = time.monotonic()
        own = parameters.values(self, OWN_SETTINGS)
        settings = EstimatorSettings(**parameters.values(self, declared(EstimatorSettings)))
        indicators = IndicatorSettings(**parameters.values(self, declared(IndicatorSettings)))
        track = load_track(own['track'])
        self._vehicle = load_vehicle(own['vehicle'])
        self._estimator = Estimator(track, self._vehicle, settings)
        self._frame_id = own['frame_id']
        self._results = ResultMessages(self._vehicle, LIVE, indicators, settings)
        self._configuration = LIVE.get(configuration.TYPE)(
            data=configuration.write_configuration(track, self._vehicle, settings, indicators))
        try_out(self._estimator, self._results, self._vehicle)
        for topic, type_name in ResultMessages.topics(self._vehicle).items():
            self._offer(topic, f'~/{topic}', type_name, RESULT)
        self._offer(CONFIGURATION, f'~/{CONFIGURATION}', configuration.TYPE, LATCHED)
        self._offer(DIAGNOSTICS, '/diagnostics', codec.DIAGNOSTICS, RESULT)
        self._configured = True
        self.get_logger().info(
            f'{self._vehicle.name} on {track.name}: {len(self._vehicle.axle_boxes)} axle boxes, '
            f'model ready after {time.monotonic() - begun:.1f} s')

    def _offer(self, key: str, topic: str, type_name: str, qos: QoSProfile) -> None:
        # rclpy looks after the events of every publisher in every round, which for those of all
        # axle boxes together costs as much as an estimate: the waveforms alone warn of readers
        # with an incompatible quality of service.
        events = PublisherEventCallbacks(use_default_callbacks=not key.startswith('wheel/'))
        self._publishers_by_topic[key] = self.create_lifecycle_publisher(
            LIVE.get(type_name), topic, qos, event_callbacks=events,
            qos_overriding_options=overridable())

    def _release(self) -> None:
        self._configured = False
        for publisher in self._publishers_by_topic.values():
            self.destroy_lifecycle_publisher(publisher)
        self._publishers_by_topic.clear()

    def _subscribe(self) -> None:
        log = self.get_logger()
        self._guard = Guard(self._voice, log.warning, log.error)
        self._latency = Latency()
        self._lost = 0
        self._next_number: int | None = None
        self._subscribe_to('speed', self.get_parameter('speed_type').value, self._on_speed)
        self._subscribe_to('~/set_position', codec.POINT, self._on_position)
        self._subscribe_to('axle_box_acceleration', codec.WAVEFORM, self._on_acceleration)
        self._before = self._picture()
        self._diagnosed = time.monotonic()
        self._timer = self.create_timer(DIAGNOSTICS_PERIOD, self._diagnose)
        acceleration, speed = self._topic('axle_box_acceleration'), self._topic('speed')
        log.info(f'ready: waiting for {acceleration} and {speed}')

    def _subscribe_to(self, name: str, type_name: str,
                      take: Callable[[Any, Mapping[str, Any]], None]) -> None:
        message_type = LIVE.get(type_name)
        topic = self.resolve_topic_name(name)

        def receive(data: bytes, info: Mapping[str, Any]) -> None:
            self._guard.call(topic, lambda: take(decoded(data, message_type), info))

        # As bytes: a message that cannot be decoded would otherwise vanish without a word.
        self._inputs[name] = self.create_subscription(
            message_type, name, receive, SENSOR_INPUT, raw=True,  # type: ignore[arg-type]
            qos_overriding_options=overridable())

    def _unsubscribe(self) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        for subscription in self._inputs.values():
            self.destroy_subscription(subscription)
        self._inputs.clear()

    # Messages

    def _on_speed(self, message: Any, info: Mapping[str, Any]) -> None:
        self._estimator.add_speed(*codec.decode_speed(message))

    def _on_position(self, message: Any, info: Mapping[str, Any]) -> None:
        self._estimator.set_position(*codec.decode_position(message))

    def _on_acceleration(self, message: Any, info: Mapping[str, Any]) -> None:
        # The executor takes one message of each topic in a round: after a delay a block would
        # overtake speed messages that have long been here.
        take_waiting(self._inputs['speed'])
        arrival_ns = int(info['received_timestamp']) or time.time_ns()
        self._count_lost(info.get('publication_sequence_number'))
        block = codec.decode_waveform(message)
        estimate = self._estimator.process(block.stamp_ns, block.t, block.channels)
        for note in self._estimator.take_notes():
            self._voice.say(note, self.get_logger().warning)
        if estimate is None:
            return
        for topic, result in self._results.block(estimate, self._frame_id):
            self._publish(topic, result)
            if topic == WAVEFORMS[-1]:
                self._latency.add(arrival_ns, time.time_ns())

    def _publish(self, topic: str, message: Any) -> None:
        self._publishers_by_topic[topic].publish(message)

    def _count_lost(self, number: int | None) -> None:
        """Count gaps in the publisher's numbers; they mean nothing with several publishers."""
        if number is None or self._inputs['axle_box_acceleration'].get_publisher_count() != 1:
            self._next_number = None
            return
        if self._next_number is not None and self._next_number < number < self._next_number + 10**6:
            self._lost += number - self._next_number
        self._next_number = number + 1

    # Diagnostics

    def _diagnose(self) -> None:
        now, moment = self._picture(), time.monotonic()
        statuses = diagnostics.statuses(
            now, self._before, moment - self._diagnosed, self._vehicle,
            self.get_fully_qualified_name().lstrip('/'), self.get_parameter('latency_limit').value)
        self._before, self._diagnosed = now, moment
        stamp_ns = self.get_clock().now().nanoseconds
        message = codec.encode_diagnostics(stamp_ns, statuses, LIVE)
        self._publish(DIAGNOSTICS, message)

    def _picture(self) -> Picture:
        return Picture(
            health=self._estimator.health,
            acceleration_topic=self._topic('axle_box_acceleration'),
            speed_topic=self._topic('speed'),
            publishers={subscription.topic_name: subscription.get_publisher_count()
                        for subscription in self._inputs.values()},
            refused=dict(self._guard.refused),
            last_refusal=dict(self._guard.last),
            lost=self._lost,
            latency=self._latency.figures(),
        )

    def _topic(self, name: str) -> str:
        return str(self._inputs[name].topic_name)

    # Parameters

    def _check_change(self, changes: list[Parameter]) -> SetParametersResult:
        """Refuse a change that is out of range, or that cannot take effect now."""
        known = {item.name: item for item in SETTINGS}
        for change in changes:
            if change.name not in known:
                continue
            try:
                parameters.check(known[change.name], change.value)
            except InputError as error:
                return SetParametersResult(successful=False, reason=str(error))
            if self._configured and change.name not in CHANGEABLE:
                return SetParametersResult(successful=False, reason=(
                    f'parameter {change.name} is taken up when the node is configured: '
                    'deactivate and clean it up first'))
        return SetParametersResult(successful=True)


def take_waiting(subscription: Subscription) -> None:
    """Call the callback of a subscription with every message that has arrived."""
    handle = subscription.handle
    while True:
        with handle:
            taken = handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return
        subscription.callback(*taken)


def decoded(data: bytes, message_type: Any) -> Any:
    """Return the message in CDR bytes; InputError where they are not of that type."""
    try:
        return deserialize_message(data, message_type)
    except Exception as error:
        raise InputError(f'the bytes are not a {message_type.__name__}') from error


def try_out(estimator: Estimator, results: ResultMessages, vehicle: Vehicle) -> None:
    """Run copies over a second of a standing start, so that compiling delays no real block."""
    estimator, results = copy.deepcopy(estimator), copy.deepcopy(results)
    samples = round(TRIAL_RATE / 100)
    t = np.arange(samples) / TRIAL_RATE
    channels = {box.name: np.zeros(samples) for box in vehicle.axle_boxes}
    for index in range(-10, 100):
        stamp_ns = index * codec.SECOND // 100
        estimator.add_speed(stamp_ns, 10.0)
        if index < 0:
            continue
        estimate = estimator.process(stamp_ns, t, channels)
        if estimate is not None:
            list(results.block(estimate, ''))


def make_node() -> TrackEstimator:
    """Return the node, active if it starts by itself."""
    node = TrackEstimator()
    if node.autostart:
        for transition in (node.trigger_configure, node.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                reason = node.failure
                node.destroy_node()
                raise InputError(reason)
    return node


def main() -> int:
    """Run the node."""
    return run(make_node)


if __name__ == '__main__':
    sys.exit(main())
