"""The public Python peer with a moving wheel, railFE by Cyprien Hoelzl, on the same case.

railFE's own example: 41 point supports with 4 TIM4 elements a bay, a quarter car at 18 m/s, steps
of 0.1 ms, all parameters taken from its objects; a dip of 0.1 mm is added.  In its published state
the contact is a linear spring.  It solves the whole dense system in every iteration, moves it on
by a bay at a time as the full model does, and starts with a jolt that has died away after two bays.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from measuring import Figure
from numpy.typing import NDArray

from railtrack_ros.dynamics.newmark import FullModel
from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import Rail, Support, Track
from railtrack_ros.vehicle.description import Contact, Suspension, Vehicle, Wheel

TITLE = 'the public Python peer railFE, same case'
INSTALL = ('pip install git+https://github.com/CyprienHoelzl/railFE@'
           '7cb5bdea573468d1d1c019eef4581d23287105d7')

SPEED = 18.0  # m/s
STEP = 1e-4  # s
STEPS = 2600
SLEEPERS, SPACING = 41, 0.6
GRAVITY = 9.81  # m/s2, as in railFE
BATCH = 50  # steps of railFE in one measurement
REPEATS = 20

Array = NDArray[np.float64]


def figures() -> Iterator[Figure]:
    """Measure; each figure is yielded as soon as it is known."""
    try:
        assembly = importlib.import_module('railFE.SystemAssembly')
        integration = importlib.import_module('railFE.Newmark_NL')
    except ImportError as error:
        print(f'  skipped, {error}: {INSTALL}', file=sys.stderr)
        return
    vars(np).setdefault('infty', np.inf)  # it was written for NumPy 1

    rolled = SPEED * STEP * np.arange(STEPS)  # from midspan to midspan
    irregularity = _dip(rolled)
    clock: list[float] = []

    def roughness(t: float) -> float:
        # Downwards, and used one step later; called in every iteration.
        step = round(t / STEP)
        if step % BATCH == 0 and step // BATCH == len(clock):
            clock.append(time.process_time())
        return -float(_dip(SPEED * (t + STEP)))

    with contextlib.redirect_stdout(sys.stderr):
        system = assembly.OverallSystem('pt', SLEEPERS, function_track_roughness=roughness)
        force, wheel = _railfe(system, integration)
    theirs = 1e6 * float(np.diff(clock).min()) / BATCH
    yield Figure('railFE', theirs, 'us/step')

    vehicle = _vehicle(system)
    stiffness, load = vehicle.contact.stiffness, vehicle.wheel.static_load
    deflection = wheel + force / stiffness - irregularity
    bay = make_bay(_track(system), Mesh(elements_per_bay=4))
    smooth = (rolled > 2 * SPACING) & (rolled < 5 * SPACING)
    dip = rolled > 5 * SPACING
    kinds: tuple[tuple[str, Callable[..., Any], dict[str, int]], ...] = (
        (f'full model, {SLEEPERS + 1} bays', FullModel, {'margin': SLEEPERS // 2}),
        ('recursion', RecursiveForward, {}))
    for name, kind, options in kinds:
        taken = []
        for _ in range(REPEATS):
            model = kind(bay, vehicle, (0.0,), STEP, -0.5 * SPACING, **options)
            begun = time.process_time()
            result = model.run(rolled - 0.5 * SPACING, irregularity[:, None])
            taken.append(1e6 * (time.process_time() - begun) / STEPS)
        yield Figure(name, min(taken), 'us/step')
        yield Figure(f'{name}: against railFE', theirs / min(taken), 'times faster')
        ours, rail = result.contact_force[:, 0], result.rail_deflection[:, 0]
        yield Figure(f'{name}: contact force apart, smooth rail, rms',
                     100.0 * float(np.std((force - ours)[smooth])) / load, '% of static load',
                     at_most=0.3)
        for what, one, other, limit in (('contact force', force, ours, 10.0),
                                        ('deflection under the wheel', deflection, rail, 1.0)):
            yield Figure(f'{name}: mean {what} apart, smooth rail',
                         100.0 * abs(one[smooth].mean() / other[smooth].mean() - 1.0), '%',
                         at_most=0.2)
            yield Figure(f'{name}: varying {what} apart, dip, rms',
                         100.0 * float(np.std((one - other)[dip]) / np.std(other[dip])), '%',
                         at_most=limit)


def _dip(x: Any) -> Any:
    """Cosine dip [m], 0.3 m long and 0.1 mm deep, over a sleeper."""
    s = (np.asarray(x) - 5.5 * SPACING) / 0.3
    return np.where(np.abs(s) < 0.5, -1e-4 * np.cos(np.pi * s) ** 2, 0.0)


def _railfe(system: Any, integration: Any) -> tuple[Array, Array]:
    """Contact force [N] and wheel displacement [m] of railFE's run, each (STEPS,)."""
    contact = system.Track.Timoshenko4.railproperties.K_c0
    place, segment = system.timeToLocalReference(0.0, SPEED)
    spring, _ = system.Local.assembleLocalMatricesStatic(place, segment, contact, 0.0)
    standing = np.linalg.solve(system.K_sys - spring, system.f_sys)
    run = integration.TimeIntegrationNM(system, standing, SPEED, (STEPS - 0.5) * STEP, STEP)
    integration.newmark_nl(run)
    # Its first column is the equilibrium, the second the wheel still at its start.
    bogie, wheel, acceleration = (array[1:STEPS + 1] for array in (run.U[1], run.U[2], run.A[2]))
    axle = system.Vehicle.Axle  # its weight rests on the bogie
    return axle.M_axle * acceleration + axle.K_prim_spring * (wheel - bogie), wheel


def _track(system: Any) -> Track:
    track = system.Track
    rail = track.Timoshenko4.railproperties
    return Track('railFE', Rail(
        youngs_modulus=rail.E, poisson_ratio=0.5 * rail.E / rail.G - 1.0, area=rail.A,
        second_moment=rail.I, density=rail.rho, shear_coefficient=rail.k, loss_factor=0.0,
    ), Support(
        kind='concentrated', spacing=track.sleeper_spacing, pad_length=track.support_length,
        pad_stiffness=track.Pad.K_p, pad_damping=track.Pad.C_p,
        sleeper_mass=track.SleeperB90.m_s_half,
        ballast_stiffness=track.Ballast.K_b, ballast_damping=track.Ballast.C_b))


def _vehicle(system: Any) -> Vehicle:
    """Wheel under its suspension; the stiff damper above makes bogie and body one mass."""
    axle, bogie, body = system.Vehicle.Axle, system.Vehicle.Bogie, system.Vehicle.CarBody
    suspension = Suspension(axle.K_prim_spring, axle.D_prim_damper, bogie.M_bogie + body.M_car)
    load = GRAVITY * (axle.M_axle + body.M_car)  # railFE leaves out the bogie's weight
    stiffness = system.Track.Timoshenko4.railproperties.K_c0
    return Vehicle('railFE', Wheel(axle.M_axle, load, 0.46, suspension), Contact(stiffness, 1.0),
                   axle_boxes=())
