"""Command `railtrack simulate`."""

from __future__ import annotations

import argparse
import csv
from typing import TYPE_CHECKING, Any

import numpy as np

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.errors import InputError
from railtrack_ros.output import metres
from railtrack_ros.parameters import POSITIVE

if TYPE_CHECKING:
    from railtrack_ros.runs.forward_run import Chunk, ForwardRun

EXAMPLE = (
    'railtrack simulate --track blanco_table_3_1 --vehicle blanco_table_3_1 --solver newmark\n'
    '      --speed 24 --start 0 --distance 15 --time-step 25e-6 --output run.csv'
)
COLUMNS = ('time_s', 'axle_box', 'position_m', 'contact_force_n', 'rail_deflection_m',
           'wheel_displacement_m', 'axle_box_acceleration_m_s2')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_track(parser)
    common.add_vehicle(parser)
    number = common.number
    parser.add_argument('--solver', choices=('newmark', 'irf', 'recursive'), default='newmark',
                        help='newmark: the full model (default); irf: convolution with impulse '
                        'responses; recursive: the same convolution as a recursion')
    speed = parser.add_mutually_exclusive_group(required=True)
    speed.add_argument('--speed', type=number(POSITIVE), metavar='V0', help='constant speed, m/s')
    speed.add_argument('--speed-file', metavar='CSV',
                       help='time_s, speed_m_s; linear in between, negative is backwards')
    parser.add_argument('--start', type=number(), default=0.0, metavar='X',
                        help='track position of the reference point at the start, m (default 0); '
                        'the wheels stand in static equilibrium there')
    parser.add_argument('--distance', type=number(POSITIVE), metavar='D',
                        help='distance to run, m; with --speed-file the whole file unless given')
    parser.add_argument('--irregularity', metavar='CSV|KIND:...', action='append', default=[],
                        help='a CSV of position_m and irregularity_m, or irregularity_left_m and '
                        'irregularity_right_m; or iso3095:SEED, sine:WAVELENGTH:AMPLITUDE, '
                        'corrugation:WAVELENGTH:AMPLITUDE:FROM:TO, joint:AT:DEPTH:LENGTH, '
                        'flat:LENGTH:DEPTH[:AXLE_BOX], all in m; given several times they add up '
                        '(default: smooth)')
    parser.add_argument('--time-step', type=number(POSITIVE), default=25e-6, metavar='DT',
                        help='s (default 25e-6)')
    parser.add_argument('--every', type=common.count(), default=1, metavar='N',
                        help='write every N-th time step (default 1)')
    newmark = parser.add_argument_group('solver newmark')
    newmark.add_argument('--margin', type=common.count(2), metavar='BAYS',
                         help='bays of track beyond the outermost wheels (default 40, more where '
                         'waves run further, 90 on a rail without loss)')
    newmark.add_argument('--newmark-beta', type=number(POSITIVE), default=0.25, metavar='BETA',
                         help='default 0.25')
    newmark.add_argument('--newmark-gamma', type=number(POSITIVE), default=0.5, metavar='GAMMA',
                         help='default 0.5; more damps high frequencies')
    newmark.add_argument('--tolerance', type=number(POSITIVE), default=1e-10, metavar='X',
                         help='relative change of an indentation at which the iteration of a time '
                         'step stops (default 1e-10)')
    newmark.add_argument('--iteration', choices=('newton', 'fixed'), default='newton',
                         help='newton: exact Jacobian (default); fixed: the constant matrix of the '
                         'track, contact forces on the right-hand side')
    online = parser.add_argument_group('solvers irf and recursive')
    online.add_argument('--hold', choices=('trapezoidal', 'linear'),
                        help="trapezoidal: the full model's time integration (default); linear: "
                        'exact exponentials for forces that are linear within a time step, for '
                        'coarse steps')
    online.add_argument('--memory', type=number(POSITIVE), metavar='S',
                        help='irf: length of the impulse responses (default: until 0.1 %% '
                        'of a deflection is left, 0.1 to 0.3)')
    online.add_argument('--cut-off', type=number(POSITIVE), metavar='HZ',
                        help='recursive: poles up to here are kept one by one (default 6000)')
    online.add_argument('--bays-in-ring', type=common.count(3), metavar='N',
                        help='recursive: bays of the periodic track (default: as many as its waves '
                        'need)')
    common.add_output(parser, 'CSV', ', '.join(COLUMNS))
    common.add_model_options(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Run the simulation and write it as it goes."""
    from railtrack_ros.dynamics.forward import StepFailure
    from railtrack_ros.irregularity.surface import read_part
    from railtrack_ros.output import replacing
    from railtrack_ros.runs.forward_run import (
        ForwardRun,
        ForwardSettings,
        NewmarkOptions,
        OnlineOptions,
        constant_speed,
        read_speed,
    )
    from railtrack_ros.vehicle.description import load_vehicle

    if args.speed is not None and args.distance is None:
        raise InputError('--distance is required with --speed')
    track, mesh = common.model(args)
    vehicle = load_vehicle(args.vehicle)
    speed = (read_speed(args.speed_file) if args.speed is None
             else constant_speed(args.speed, args.distance))
    forward = ForwardRun(track, mesh, vehicle, ForwardSettings(
        solver=args.solver, speed=speed, start=args.start, time_step=args.time_step,
        distance=args.distance, irregularity=tuple(map(read_part, args.irregularity)),
        newmark=NewmarkOptions(args.margin, args.newmark_beta, args.newmark_gamma, args.tolerance,
                               args.iteration),
        online=OnlineOptions(args.hold, args.memory, args.cut_off, args.bays_in_ring)))

    statistics = _Statistics(len(vehicle.axle_boxes))
    failure = None
    with replacing(args.output) as place, open(place, 'w', encoding='utf-8', newline='') as file, \
            common.progress(forward.steps, 'steps', 'simulation') as bar:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(COLUMNS)
        try:
            for chunk in forward:
                _write(writer, chunk, [box.name for box in vehicle.axle_boxes],
                       -statistics.steps % args.every, args.every)
                statistics.add(chunk)
                bar.update(chunk.time.size)
        except StepFailure as error:
            failure = error
    if failure is not None:
        raise InputError(f'{failure} (the {statistics.steps} time steps before are in '
                         f'{args.output})')
    return _outcome(args, forward, statistics)


def _write(writer: Any, chunk: Chunk, names: list[str], first: int, every: int) -> None:
    """Write the rows of a chunk: every axle box at one time, then the next time."""
    picked = slice(first, None, every)
    t = chunk.time[picked]
    columns = [array[picked].ravel().tolist()
               for array in (chunk.position, *chunk.result.arrays())]
    times = np.repeat(t, len(names)).tolist()
    writer.writerows(zip(times, names * t.size, *columns, strict=True))


class _Statistics:
    """Extremes of a run, by axle box."""

    def __init__(self, boxes: int) -> None:
        self.steps = 0
        self.apart = np.zeros(boxes, dtype=int)
        self.least = np.full((2, boxes), np.inf)  # force, deflection
        self.greatest = np.full((2, boxes), -np.inf)
        self.sum = np.zeros(boxes)
        self.last_time = 0.0

    def add(self, chunk: Chunk) -> None:
        if chunk.time.size == 0:
            return
        force, deflection = chunk.result.contact_force, chunk.result.rail_deflection
        self.steps += chunk.time.size
        self.apart += (force == 0.0).sum(axis=0)
        self.sum += force.sum(axis=0)
        for i, array in enumerate((force, deflection)):
            self.least[i] = np.minimum(self.least[i], array.min(axis=0))
            self.greatest[i] = np.maximum(self.greatest[i], array.max(axis=0))
        self.last_time = float(chunk.time[-1])


def _newmark(forward: ForwardRun) -> dict[str, Any]:
    """What the summary says of the full model's time integration."""
    settings, (most, most_support) = forward.settings, forward.most_iterations
    if settings.solver != 'newmark':
        return {'hold': settings.online.hold or 'trapezoidal'}
    found = {'most_iterations': most, 'tolerance': settings.newmark.tolerance,
             'iteration': settings.newmark.iteration, 'newmark_beta': settings.newmark.beta,
             'newmark_gamma': settings.newmark.gamma}
    if most_support:
        found |= {'support_iterations_per_step': forward.support_iterations_per_step,
                  'most_support_iterations': most_support}
    return found


def _outcome(args: argparse.Namespace, forward: ForwardRun, statistics: _Statistics) -> Outcome:
    bay, boxes = forward.bay, forward.vehicle.axle_boxes
    settings = forward.settings
    travelled = float(settings.speed.distance_at(np.array([statistics.last_time]))[0])
    rails = len(forward.vehicle.rails)
    per_step = forward.seconds / max(1, statistics.steps - 2)
    per_box = {
        box.name: {
            'rail': box.rail,
            'contact_force_n': {'min': statistics.least[0, i], 'max': statistics.greatest[0, i],
                                'mean': statistics.sum[i] / statistics.steps},
            'rail_deflection_m': {'min': statistics.least[1, i], 'max': statistics.greatest[1, i]},
            'time_without_contact_s': float(statistics.apart[i] * settings.time_step),
        } for i, box in enumerate(boxes)
    }
    summary = {
        'solver': settings.solver, 'track': bay.track.name, 'support': bay.track.support.kind,
        'vehicle': forward.vehicle.name, 'local_system': bay.mesh.local_system,
        'elements_per_bay': len(bay.nodes) - 1, 'loss_factor': bay.track.rail.loss_factor,
        'time_step_s': settings.time_step, 'steps': statistics.steps,
        'duration_s': statistics.last_time, 'start_m': settings.start,
        'end_m': settings.start + travelled, 'iterations_per_step': forward.iterations_per_step,
        **_newmark(forward),
        'computing_s': forward.seconds, 'microseconds_per_step': 1e6 * per_step,
        'times_real_time': settings.time_step / per_step if per_step else None,
        'axle_boxes': per_box, 'output': args.output,
    }
    lines = [
        f'{bay.track.name}, {bay.track.support.kind} supports, {forward.vehicle.name}: '
        f'{statistics.steps} time steps, {metres(settings.start)} to '
        f'{metres(settings.start + travelled)} m',
    ]
    for i, box in enumerate(boxes):
        apart = statistics.apart[i] * settings.time_step
        lines.append(
            f'{box.name}: contact force {statistics.least[0, i] / 1e3:.2f} to '
            f'{statistics.greatest[0, i] / 1e3:.2f} kN, rail deflection '
            f'{1e3 * statistics.least[1, i]:.4f} to {1e3 * statistics.greatest[1, i]:.4f} mm'
            + (f', {1e3 * apart:.3g} ms without contact' if apart else ''))
    lines += [
        f'{settings.solver}: {1e6 * per_step:.3g} us a step for {len(boxes)} wheel'
        f'{"s" if len(boxes) > 1 else ""} on {rails} rail{"s" if rails > 1 else ""}, '
        f'{forward.iterations_per_step:.2f} '
        f'{"fixed-matrix" if settings.newmark.iteration == "fixed" else "Newton"} iterations a '
        'step' + (f' in {forward.support_iterations_per_step:.2f} rounds of the supports'
                  if forward.support_iterations_per_step else '')
        + (f' to a tolerance of {settings.newmark.tolerance:g}, at most '
           f'{forward.most_iterations[0]}' if settings.solver == 'newmark' else ''),
        f'written: {args.output}',
    ]
    return Outcome(summary, lines, remarks=[forward.remark] if forward.remark else [])
