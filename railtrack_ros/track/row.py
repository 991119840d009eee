"""The bays of a track one after the other, whether or not they are all alike."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import Rail, Support, Track

# Values of a support that its sleeper's own degree of freedom feels alone, and where.
SLEEPER = {'sleeper_mass': 'mass', 'ballast_stiffness': 'stiffness',
           'ballast_damping': 'support_damping'}

LONGEST_LOOK = 4096  # bays that are looked over at a time
ENDLESS = 2**60


class BayRow:
    """Every bay of a track on one mesh; equal bays are meshed once and share a number, their kind.

    Attributes
    ----------
    track, mesh
        What is meshed.
    kinds
        The bays that differ; kind 0 is that of the track's own rail and support.
    """

    def __init__(self, track: Track, mesh: Mesh | None = None) -> None:
        """Mesh all kinds of bays.

        Raises
        ------
        InputError
            The mesh does not fit a support, or neighbouring bays do not meet at a node.
        """
        self.track, self.mesh = track, mesh or Mesh()
        tracks = [Track(track.name, track.rail, track.support, track.description)]
        tracks += [Track(track.name, s.rail, s.support) for s in track.stretches]
        tracks += [track.bay(index) for index, _ in track.sleepers]
        self.kinds: list[Bay] = []
        self._kind_of: dict[tuple[Rail, Support], int] = {}
        for alike in tracks:
            key = (alike.rail, alike.support)
            if key not in self._kind_of:
                self._kind_of[key] = len(self.kinds)
                self.kinds.append(self._make(alike))
        first = self.kinds[0]
        for other in self.kinds[1:]:
            if abs(other.start - first.start) > 1e-9 or other.dofs != first.dofs:
                raise InputError(
                    f'track {track.name}: the meshes of a {first.track.support.kind} and a '
                    f'{other.track.support.kind} support do not meet at a node; take an even '
                    'number of elements between the pads')
        self._kind = lru_cache(maxsize=65536)(self._find_kind)

    @classmethod
    def periodic(cls, bay: Bay) -> BayRow:
        """The row of a bay that repeats for ever."""
        row = cls.__new__(cls)
        row.track, row.mesh, row.kinds = bay.track, bay.mesh, [bay]
        return row

    @property
    def bay(self) -> Bay:
        """The bay of the track's own rail and support."""
        return self.kinds[0]

    def kind(self, first: int, count: int) -> NDArray[np.int64]:
        """Kinds (count,) of bays first, first + 1, ..."""
        if len(self.kinds) == 1:
            return np.zeros(count, dtype=np.int64)
        return np.array([self._kind(first + k) for k in range(count)], dtype=np.int64)

    def alike(self, first: int, count: int) -> tuple[int, int]:
        """Bays (low, high) at which `count` bays may begin and be of the same kinds as at first."""
        if len(self.kinds) == 1:
            return -ENDLESS, ENDLESS
        here = self.kind(first, count)
        if (here != here[0]).any():
            return first, first
        before = self.kind(first - LONGEST_LOOK, LONGEST_LOOK)[::-1] != here[0]
        after = self.kind(first + count, LONGEST_LOOK) != here[0]
        return (first - (int(np.argmax(before)) if before.any() else LONGEST_LOOK),
                first + (int(np.argmax(after)) if after.any() else LONGEST_LOOK))

    def _make(self, track: Track) -> Bay:
        """Mesh a bay; one that differs in its sleeper and ballast alone shares the other's rail."""
        support = track.support
        for other in self.kinds:
            there = other.track.support
            own = {name: getattr(there, name) for name in SLEEPER}
            alike = dataclasses.replace(
                support, **own, ballast_lift_off=there.ballast_lift_off)
            if track.rail != other.track.rail or alike != there:
                continue
            changed = {matrix: getattr(other, matrix).copy() for matrix in SLEEPER.values()}
            sleeper = other.sleeper_dof
            for name, matrix in SLEEPER.items():
                changed[matrix][sleeper, sleeper] += getattr(support, name) - own[name]
            return dataclasses.replace(other, track=track, **changed)
        return make_bay(track, self.mesh, tangent=True)

    def _find_kind(self, number: int) -> int:
        own = self.track.bay(number)
        return self._kind_of[own.rail, own.support]
