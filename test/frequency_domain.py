"""What the tests of the frequency domain share."""

import dataclasses

from railtrack_ros.track.description import SUPPORT_KINDS

KINDS = SUPPORT_KINDS


def variant(track, loss_factor=None, **support):
    """A track with another rail loss factor or other support values."""
    rail = track.rail
    if loss_factor is not None:
        rail = dataclasses.replace(rail, loss_factor=loss_factor)
    return dataclasses.replace(
        track, rail=rail, support=dataclasses.replace(track.support, **support))


def undamped(track, kind):
    """The same track without any damping."""
    return variant(track, 0.0, kind=kind, pad_damping=0.0, ballast_damping=0.0)
