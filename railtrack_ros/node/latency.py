"""Delay from the arrival of a block to the publication of its results."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

# Blocks which the figures are about: 30 s of 10 ms blocks.
MEMORY = 3000


@dataclass(frozen=True)
class LatencyFigures:
    """Percentiles of the last blocks, and the worst since the start; all in seconds."""

    blocks: int
    p50: float
    p99: float
    worst: float


class Latency:
    """Keeps the delays of the last blocks."""

    def __init__(self) -> None:
        self._delays: deque[float] = deque(maxlen=MEMORY)
        self._worst = 0.0

    def add(self, arrival_ns: int, published_ns: int) -> None:
        """Take the times of a block, nanoseconds of the same clock."""
        delay = max(published_ns - arrival_ns, 0) * 1e-9
        self._delays.append(delay)
        self._worst = max(self._worst, delay)

    def figures(self) -> LatencyFigures:
        """Return the figures; zeros before the first block."""
        if not self._delays:
            return LatencyFigures(0, 0.0, 0.0, 0.0)
        p50, p99 = np.percentile(self._delays, (50.0, 99.0))
        return LatencyFigures(len(self._delays), float(p50), float(p99), self._worst)
