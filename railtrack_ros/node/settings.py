"""The parameters of the node `track_estimator`: its own, and those of what it is made of."""

from __future__ import annotations

from railtrack_ros.bags import codec
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings, declared
from railtrack_ros.node.limits import Limits
from railtrack_ros.node.parameters import setting
from railtrack_ros.parameters import POSITIVE, Range

OWN_SETTINGS = (
    setting('autostart', True, 'configure and activate at the start; false: wait to be told'),
    setting('track', 'mainline_soft_pads', 'shipped track or path of a YAML file'),
    setting('vehicle', 'measurement_coach', 'shipped vehicle or path of a YAML file'),
    setting('frame_id', 'base_link', "the vehicle's frame, in the header of the results"),
    setting('acceleration_topic', 'axle_box_acceleration',
            'topic of the acceleration; single samples come on a topic of their own for each axle '
            'box, acceleration_topic/NAME'),
    setting('acceleration_type', codec.WAVEFORM,
            'message type of the acceleration: blocks of samples, or single samples of sensors of '
            'up to about 1 kHz, whose z axis counts', '',
            choices=(codec.WAVEFORM, codec.IMU, codec.ACCELERATION)),
    setting('sample_rate', 25600.0, 'sample rate of the acceleration for which the node prepares '
            'itself when it is configured; at any other the first block takes a second or so',
            'Hz', Range(minimum=100.0, maximum=200e3)),
    setting('sample_block', 0.05, 'single samples are gathered to blocks of this length', 's',
            Range(minimum=0.002, maximum=1.0)),
    setting('speed_topic', 'speed', 'topic of the speed'),
    setting('speed_type', codec.TWIST, 'message type of the speed', '',
            choices=(codec.TWIST, codec.ODOMETRY)),
    setting('gnss_topic', 'gnss', 'topic of sensor_msgs/msg/NavSatFix; nothing needs it'),
    setting('gnss_table', '', 'CSV file that gets a line with track position, latitude and '
            'longitude for each GNSS fix, for maps; empty: none'),
    setting('shed_delay', 0.5, 'a block that has waited longer than this is dropped together with '
            'all that wait behind it: the way out of an overload', 's', POSITIVE),
)
SETTINGS = (*OWN_SETTINGS, *declared(EstimatorSettings), *declared(IndicatorSettings),
            *declared(Limits))
# May change at any time; everything else is taken up when the node is configured.
CHANGEABLE = ('shed_delay', *(item.name for item in declared(Limits)))
