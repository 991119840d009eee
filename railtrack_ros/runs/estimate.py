"""The estimator over a recording: inputs and results into a new one."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from railtrack_ros.bags.bag import Paths, paths_of
from railtrack_ros.bags.reader import read_run
from railtrack_ros.bags.writer import Recording
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.samples import SAMPLE_BLOCK
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.runs.estimate_pipeline import NODE, Case, Pipeline, conclude
from railtrack_ros.runs.estimated import Estimated
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

__all__ = ['NODE', 'Estimated', 'estimate']


def estimate(
    bag: Paths,
    track: Track,
    vehicle: Vehicle,
    output: str | Path,
    settings: EstimatorSettings | None = None,
    indicators: IndicatorSettings | None = None,
    start_position: float | None = None,
    acceleration_topic: str | None = None,
    speed_topic: str | None = None,
    progress: Callable[[float, float], None] = lambda done, total: None,
    jobs: int = 1,
    sample_block: float = SAMPLE_BLOCK,
) -> Estimated:
    """Run the estimator over a recording and write inputs and results to another.

    Every message of the recording is copied but for earlier results of an estimator; the results
    are logged at the time of the block that they belong to.

    Parameters
    ----------
    bag, output
        Recordings: a rosbag2 folder or an `.mcap` file; several inputs are one run.
    settings, indicators
        Those of the estimator and of the sections.
    start_position
        Track position at the first sample [m]; None: as the recording tells, else the setting.
    acceleration_topic, speed_topic
        Input topics, None for the usual ones.
    progress
        Called with the seconds that are done, and all of them.
    jobs
        Processes that share the work, 0: one for each core. Each takes a part of the run with a
        warm-up before it (:mod:`railtrack_ros.runs.estimate_jobs` tells how equal the results
        are); single samples, which are few, are left to one.
    sample_block
        Single samples are gathered to blocks of about this length [s].

    Raises
    ------
    InputError
        Nothing can be estimated: no inputs, no axle box of the vehicle among the channels, no
        speed, standstill all the time, or a run too short to settle.
    """
    paths = paths_of(bag)
    jobs = jobs or os.cpu_count() or 1
    if jobs < 0:
        raise InputError(f'jobs: expected at least 0, got {jobs}')
    names = [box.name for box in vehicle.axle_boxes]
    with read_run(paths, acceleration_topic, speed_topic, everything=True, names=names,
                  sample_block=sample_block) as run:
        settings = settings or EstimatorSettings()
        if start_position is None:
            start_position = run.start_position
        if start_position is not None:
            settings = replace(settings, start_position=start_position)
        case = Case(track, vehicle, settings, indicators or IndicatorSettings())
        start = run.bag.start_time
        seconds = (run.bag.end_time - start) / 1e9
        if jobs > 1 and not run.samples:
            from railtrack_ros.runs.estimate_jobs import estimate_in_parts

            return estimate_in_parts(
                run, paths, case, output, jobs, lambda done: progress(done, seconds))
        with Recording(output, inputs=paths) as recording:
            case.begin(recording, run)
            pipeline = Pipeline(run, recording, case)
            for time_ns in pipeline.steps():
                progress((time_ns - start) / 1e9, seconds)
            return conclude(pipeline.result, run, recording, vehicle)
