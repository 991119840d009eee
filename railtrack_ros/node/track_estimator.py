"""Node `track_estimator`: acceleration and speed in, force, deflection and irregularity out.

A lifecycle node without any mechanics: it decodes messages, calls the estimator, and publishes.
Configuring computes the model, activating subscribes; with the parameter `autostart` it does
both by itself.
"""

from __future__ import annotations

if __name__ == '__main__':  # before the long imports: a signal may come at any time
    import sys

    from railtrack_ros.node.start import start

    sys.exit(start('track_estimator'))

import gc
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import (
    LifecycleNode,
    LifecyclePublisher,
    LifecycleState,
    TransitionCallbackReturn,
)
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.timer import Timer

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import WaveformBlock
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import EstimateBlock, Estimator
from railtrack_ros.estimation.odometer import FASTEST
from railtrack_ros.estimation.samples import SampleCollector
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings, declared
from railtrack_ros.node import diagnostics, gnss, parameters
from railtrack_ros.node.diagnostics import Picture
from railtrack_ros.node.gnss import Locations
from railtrack_ros.node.guard import Guard, Voice
from railtrack_ros.node.inputs import Info, Input, arrival_ns, sent_ns
from railtrack_ros.node.latency import Latency
from railtrack_ros.node.limits import Limits
from railtrack_ros.node.polarity import Polarity
from railtrack_ros.node.processes import resident_memory
from railtrack_ros.node.qos import LATCHED, RESULT, SENSOR_INPUT, SINGLE_INPUT, overridable
from railtrack_ros.node.runner import run
from railtrack_ros.node.settings import CHANGEABLE, OWN_SETTINGS, SETTINGS
from railtrack_ros.node.trial import try_out
from railtrack_ros.node.watch import BlockWatch, SpeedWatch
from railtrack_ros.runs import configuration
from railtrack_ros.runs.results import CONFIGURATION, WAVEFORMS, ResultMessages
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

NAME = 'track_estimator'
DIAGNOSTICS = 'diagnostics'
POSITION = 'position'

DIAGNOSTICS_PERIOD = 1.0  # s
POSITION_PERIOD = codec.SECOND // 10  # ns


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
        self._inputs: list[Input] = []
        self._blocks: list[Input] = []  # those of them with the acceleration
        self._locations: Locations | None = None
        self._timer: Timer | None = None
        self._voice = Voice()
        self._limits = Limits()
        self._shed = 0
        self._diagnosed = time.monotonic()
        self._processor_time = time.process_time()

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
        try_out(self._estimator, self._results, self._vehicle, own['sample_rate'])
        for topic, type_name in ResultMessages.topics(self._vehicle, indicators).items():
            self._offer(topic, f'~/{topic}', type_name, RESULT)
        self._offer(POSITION, f'~/{POSITION}', codec.POINT, RESULT)
        self._offer(CONFIGURATION, f'~/{CONFIGURATION}', configuration.TYPE, LATCHED)
        self._offer(DIAGNOSTICS, '/diagnostics', codec.DIAGNOSTICS, RESULT)
        self._configured = True
        # What is there now stays: the collector of garbage need not look at it again and again.
        gc.collect()
        gc.freeze()
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
        own = parameters.values(self, OWN_SETTINGS)
        names = [box.name for box in self._vehicle.axle_boxes]
        self._guard = Guard(self._voice, self._warn, self._complain)
        self._latency = Latency()
        self._watch, self._speed_watch = BlockWatch(names), SpeedWatch()
        self._polarity = Polarity(self._vehicle)
        self._locations = Locations(Path(own['gnss_table']) if own['gnss_table'] else None)
        self._positioned_ns = -(2**62)
        self._listen_to(own, names)
        self._adopt_limits()
        self._before, self._diagnosed = self._picture(), time.monotonic()
        # Health goes by the time of day, also where a recording sets the clock of the node.
        self._timer = self.create_timer(DIAGNOSTICS_PERIOD, self._diagnose,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(
            f'ready: waiting for {self._acceleration_topic} and {self._speed.topic}')

    def _listen_to(self, own: dict[str, Any], names: list[str]) -> None:
        """Subscribe to the inputs."""
        def listen(name: str, type_name: str, take: Callable[[Any, Info], None],
                   qos: QoSProfile = SENSOR_INPUT, greedy: bool = False) -> Input:
            found = Input(self, name, type_name, take, self._guard, qos, greedy)
            self._inputs.append(found)
            return found

        self._speed = listen(own['speed_topic'], own['speed_type'], self._on_speed, greedy=True)
        listen('~/set_position', codec.POINT, self._on_position)
        self._gnss = listen(own['gnss_topic'], gnss.NAVSATFIX, self._on_fix)
        topic, type_name = own['acceleration_topic'], own['acceleration_type']
        if type_name == codec.WAVEFORM:
            self._blocks = [listen(topic, type_name, self._on_block)]
            self._acceleration_topic = self._blocks[0].topic
        else:
            self._collector = SampleCollector(names, own['sample_block'])
            self._blocks = [
                listen(f'{topic}/{name}', type_name, partial(self._on_sample, name), SINGLE_INPUT,
                       greedy=True)
                for name in names]
            self._acceleration_topic = f'{self.resolve_topic_name(topic)}/NAME'

    def _unsubscribe(self) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        for source in self._inputs:
            source.close()
        self._inputs, self._blocks = [], []
        if self._locations is not None:
            self._locations.close()

    # Messages

    def _on_speed(self, message: Any, info: Info) -> None:
        stamp_ns, speed = codec.decode_speed(message)
        self._estimator.add_speed(stamp_ns, speed)
        if abs(speed) <= FASTEST:
            self._speed_watch.add(stamp_ns, speed)

    def _on_position(self, message: Any, info: Info) -> None:
        self._estimator.set_position(*codec.decode_position(message))

    def _on_fix(self, message: Any, info: Info) -> None:
        assert self._locations is not None
        self._locations.add_fix(*gnss.decode_fix(message))

    def _on_block(self, message: Any, info: Info) -> None:
        if not self._too_late(info):
            self._estimate(codec.decode_waveform(message), info)

    def _on_sample(self, name: str, message: Any, info: Info) -> None:
        if self._too_late(info):
            return
        for block in self._collector.add(name, *codec.decode_sample(message)):
            self._estimate(WaveformBlock(block.stamp_ns, block.t, block.channels), info)

    def _too_late(self, info: Info) -> bool:
        """Drop a message that has waited too long, with all that wait behind it.

        Working them off would let every later one wait as long; dropping now and then some
        would leave no stretch that is long enough for an estimate.
        """
        waited = 1e-9 * (time.time_ns() - arrival_ns(info))
        if waited <= self._shed_delay:
            return False
        before = sum(source.shed for source in self._blocks)
        for source in self._blocks:
            source.discard_waiting()
        self._shed += 1
        count = 1 + sum(source.shed for source in self._blocks) - before
        self._voice.say(f'overload: {count} messages dropped after {waited:.2f} s of waiting',
                        self._complain)
        return True

    def _estimate(self, block: WaveformBlock, info: Info) -> None:
        # The executor takes one message of each topic in a round: after a delay a block would
        # overtake speed messages that have long been here.
        self._speed.take_waiting()
        estimate = self._estimator.process(block.stamp_ns, block.t, block.channels)
        for note in self._estimator.take_notes():
            self._voice.say(note, self._warn)
        if estimate is not None:
            for topic, result in self._results.block(estimate, self._frame_id):
                self._publish(topic, result)
                if topic == WAVEFORMS[-1]:
                    self._latency.add(arrival_ns(info), time.time_ns())
            self._publish_position(estimate)
            self._polarity.block(estimate.position, estimate.irregularity)
        self._watch.block(block.stamp_ns, block.t, sent_ns(info), block.channels)

    def _publish_position(self, estimate: EstimateBlock) -> None:
        """Publish the track position every 0.1 s, and have fixes paired with it."""
        assert self._locations is not None
        self._locations.add_positions(estimate.stamp_ns, estimate.t, estimate.position)
        end_ns = estimate.stamp_ns + round(float(estimate.t[-1]) * codec.SECOND)
        position = float(estimate.position[-1])
        if np.isfinite(position) and not 0 <= end_ns - self._positioned_ns < POSITION_PERIOD:
            self._positioned_ns = end_ns
            self._publish(POSITION, codec.encode_position(end_ns, position, self._frame_id, LIVE))

    # rclpy refuses two severities from one line of a program.
    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)

    def _complain(self, text: str) -> None:
        self.get_logger().error(text)

    def _publish(self, topic: str, message: Any) -> None:
        self._publishers_by_topic[topic].publish(message)

    # Diagnostics

    def _diagnose(self) -> None:
        self._adopt_limits()
        now, moment = self._picture(), time.monotonic()
        statuses = diagnostics.statuses(
            now, self._before, moment - self._diagnosed, self._vehicle,
            self.get_fully_qualified_name().lstrip('/'), self._limits)
        self._before, self._diagnosed = now, moment
        stamp_ns = self.get_clock().now().nanoseconds
        self._publish(DIAGNOSTICS, codec.encode_diagnostics(stamp_ns, statuses, LIVE))

    def _adopt_limits(self) -> None:
        """Take up the parameters that may change while the node runs."""
        self._limits = Limits(**parameters.values(self, declared(Limits)))
        self._shed_delay = float(self.get_parameter('shed_delay').value)
        self._watch.full_scale = self._limits.full_scale
        self._watch.jump_limit = self._limits.clock_jump_limit

    def _picture(self) -> Picture:
        """Return how things stand, and begin to watch anew."""
        assert self._locations is not None
        stamps, signals = self._watch.take()
        if self.get_parameter('use_sim_time').value and np.isfinite(stamps.offset):
            # What counts is the clock that the stamps are of.
            stamps.offset += 1e-9 * (self.get_clock().now().nanoseconds - time.time_ns())
        moment, used = time.monotonic(), time.process_time()
        period = max(moment - self._diagnosed, 1e-3)
        load, self._processor_time = (used - self._processor_time) / period, used
        return Picture(
            health=self._estimator.health,
            acceleration_topic=self._acceleration_topic,
            speed_topic=self._speed.topic,
            gnss_topic=self._gnss.topic,
            publishers={
                self._acceleration_topic: max(source.publishers for source in self._blocks),
                self._speed.topic: self._speed.publishers,
                self._gnss.topic: self._gnss.publishers,
            },
            refused=self._of_acceleration(self._guard.refused, sum),
            last_refusal=self._of_acceleration(self._guard.last, lambda found: [*found][-1]),
            lost=sum(source.lost for source in self._blocks),
            shed=self._shed + sum(source.shed for source in self._blocks),
            latency=self._latency.figures(),
            stamps=stamps,
            signals=signals,
            reversed=self._polarity.reversed(self._limits.polarity_limit),
            includes_gravity=self._estimator.settings.input_includes_gravity,
            speed_change=self._speed_watch.take(),
            speed_interval=self._speed_watch.interval,
            speed_overdue=self._speed_watch.silence > self._estimator.settings.speed_timeout,
            fixes=self._locations.fixes,
            gnss_speed=self._locations.speed,
            gnss_difference=self._locations.difference,
            residuals={
                name: {band: residual.share for band, residual in bands.items()}
                for name, bands in self._estimator.model_residual().items()},
            load=load,
            memory=resident_memory(),
        )

    def _of_acceleration(self, by_topic: Mapping[str, Any], together: Callable[[Any], Any]
                         ) -> dict[str, Any]:
        """Return values by topic, those of all topics with acceleration under one name."""
        own = [by_topic[source.topic] for source in self._blocks if source.topic in by_topic]
        return {**by_topic, **({self._acceleration_topic: together(own)} if own else {})}

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
            same = change.value == self.get_parameter(change.name).value
            if self._configured and change.name not in CHANGEABLE and not same:
                return SetParametersResult(successful=False, reason=(
                    f'parameter {change.name} is taken up when the node is configured: '
                    'deactivate and clean it up first'))
        return SetParametersResult(successful=True)


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
