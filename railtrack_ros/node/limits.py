"""What is worth a warning: the thresholds of the diagnostics, each a parameter of the node.

They only judge; none of them changes a result. All may change while the node runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from railtrack_ros.estimation.settings import setting_field
from railtrack_ros.parameters import NOT_NEGATIVE, POSITIVE, Range

SHARE = Range(minimum=0.0, maximum=1.0)


def _limit(default: float, description: str, unit: str = '', allowed: Range = NOT_NEGATIVE) -> Any:
    return setting_field(default, description, unit, allowed)


@dataclass(frozen=True)
class Limits:
    """Thresholds of the diagnostics; counts are those within one diagnostics period, a second."""

    sample_rate_limit: float = _limit(
        0.0, 'lowest sample rate of the acceleration that is no warning', 'Hz')
    gap_limit: float = _limit(0.0, 'number of gaps between blocks in a second that is no warning')
    out_of_order_limit: float = _limit(
        0.0, 'number of blocks from the past in a second that is no warning')
    duplicate_limit: float = _limit(
        0.0, 'number of repeated blocks in a second that is no warning')
    lost_limit: float = _limit(
        0.0, 'number of blocks lost on the way in a second that is no warning')
    clock_jump_limit: float = _limit(
        0.5, 'jump of the stamps against the time of sending that is a warning', 's', POSITIVE)
    clock_offset_limit: float = _limit(
        5.0, "difference between the stamps and this node's clock that is a warning", 's', POSITIVE)
    bad_sample_limit: float = _limit(
        0.0, 'share of samples that are no number that is no warning', '', SHARE)
    stuck_limit: float = _limit(
        0.5, 'a channel with one and the same value for longer than this is stuck', 's', POSITIVE)
    full_scale: float = _limit(
        0.0, 'largest value that the sensors can measure; 0: a sensor is taken to be saturated '
        'where it holds an extreme for three samples or more', 'm/s2')
    saturation_limit: float = _limit(
        0.001, 'share of saturated samples that is no warning', '', SHARE)
    offset_limit: float = _limit(
        5.0, 'mean acceleration over a second that is a warning', 'm/s2', POSITIVE)
    polarity_limit: float = _limit(
        0.5, 'an axle box whose irregularity is correlated with that of the others on its rail '
        'below minus this is wired the wrong way round', '', Range(above=0.0, maximum=1.0))
    speed_rate_limit: float = _limit(
        1.0, 'lowest rate of speed messages that is no warning', 'Hz')
    slip_limit: float = _limit(
        3.0, 'change of speed that no train reaches: the wheel that measures it slips or slides; '
        '0: not judged', 'm/s2')
    gnss_limit: float = _limit(
        0.1, 'share by which the speed may differ from that of the GNSS fixes; 0: not judged')
    latency_limit: float = _limit(
        0.05, 'a longer delay of 1 % of the results is a warning', 's', POSITIVE)
    load_limit: float = _limit(
        0.9, 'share of a processor core used by the node that is a warning', '', POSITIVE)
    residual_limit: float = _limit(
        0.5, 'share of the acceleration of an axle box in a band of frequency that the model may '
        'leave unexplained without a warning', '', POSITIVE)
