"""What benchmark modules share: a figure, and the clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured number; `at_most` and `at_least` are what it is meant to keep, if anything."""

    name: str
    value: float
    unit: str
    at_most: float | None = None
    at_least: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the target is kept; None without one."""
        if self.at_most is None and self.at_least is None:
            return None
        return ((self.at_most is None or self.value <= self.at_most)
                and (self.at_least is None or self.value >= self.at_least))


def best_time(work: Callable[[], object], repeats: int = 5) -> float:
    """Shortest duration [s] of several calls: what the machine can do when it is left alone."""
    best = float('inf')
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begun)
    return best
