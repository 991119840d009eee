"""Plots of the live benchmark."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use('agg')

import matplotlib.pyplot as plt  # noqa: E402


def plot_latency(node: np.ndarray, echo: np.ndarray, path: Path) -> None:
    """Histograms of delays [s] from the arrival of a block to the publication of its results."""
    figure, axes = plt.subplots(figsize=(8.0, 3.6), constrained_layout=True)
    low = 0.8 * min(node.min(), echo.min())
    bins = np.geomspace(max(1e3 * low, 1e-3), 1.2e3 * max(node.max(), echo.max()), 120)
    for delays, name, colour in ((echo, 'bare echo', '0.6'), (node, 'track_estimator', 'C0')):
        p50, p99 = 1e3 * np.percentile(delays, (50, 99))
        axes.hist(1e3 * delays, bins, color=colour, alpha=0.8,
                  label=f'{name}: p50 {p50:.2f}, p99 {p99:.2f}, worst {1e3 * delays.max():.1f} ms')
    for limit, name in ((3.0, 'p50'), (10.0, 'p99'), (50.0, 'worst')):
        axes.axvline(limit, color='C3', linewidth=0.8, linestyle='--')
        axes.annotate(f' {name} ≤ {limit:g} ms', (limit, 1.0), xycoords=('data', 'axes fraction'),
                      rotation=90, va='top', ha='right', fontsize=8, color='C3')
    axes.set(xscale='log', yscale='log', xlabel='delay from arrival to publication [ms]',
             ylabel='blocks')
    axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False, fontsize=9)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def plot_memory(seconds: np.ndarray, memory: np.ndarray, path: Path) -> None:
    """Memory [bytes] of the node over time [s]."""
    figure, axes = plt.subplots(figsize=(8.0, 2.4), constrained_layout=True)
    axes.plot(seconds, memory / 1e6)
    axes.set(xlabel='time [s]', ylabel='memory of the node [MB]', ylim=(0, None))
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)
