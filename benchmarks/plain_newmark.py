"""The full model written down plainly: the slow obvious twin of railtrack_ros.dynamics.newmark.

A fixed row of bays.  The unknowns of a time step are all displacements of the track, those of the
wheels and the contact forces; Newton's method assembles the sparse Jacobian and factorises it in
every iteration, as published codes do.  Nothing is shared with the fast model but the bay's
matrices and its interpolation.  It serves as reference in the tests and in the benchmark.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from railtrack_ros.dynamics.forward import ForwardResult
from railtrack_ros.track.bay import Bay
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]


class PlainModel:
    """Wheels of one rail on bays first_bay .. first_bay + bays - 1 with clamped ends."""

    def __init__(self, bay: Bay, vehicle: Vehicle, offsets: Sequence[float], time_step: float,
                 first_bay: int, bays: int, beta: float = 0.25, gamma: float = 0.5) -> None:
        self.bay, self.vehicle = bay, vehicle
        self.offsets = np.asarray(offsets, dtype=float)
        self.time_step, self.beta, self.gamma = time_step, beta, gamma
        self.first_bay, self.bays = first_bay, bays
        self.mass, self.damping, self.stiffness = self.matrices()
        self.started = False
        self.factorisations = 0

    def matrices(self) -> tuple[sparse.csc_matrix, ...]:
        """Assemble M, C, K bay by bay and clamp the ends."""
        nb, total = self.bay.dofs, self.bays * self.bay.dofs + 2
        fixed = np.array([0, 1, total - 2, total - 1])
        assembled = []
        for matrix in (self.bay.mass, self.bay.damping, self.bay.stiffness):
            grid = np.arange(nb + 2)[None, :] + nb * np.arange(self.bays)[:, None]
            row = np.repeat(grid, nb + 2, axis=1).ravel()
            column = np.tile(grid, (1, nb + 2)).ravel()
            value = np.tile(matrix.ravel(), self.bays)
            keep = ~np.isin(row, fixed) & ~np.isin(column, fixed)
            value, row, column = value[keep], row[keep], column[keep]
            if matrix is not self.bay.damping:
                row, column = np.append(row, fixed), np.append(column, fixed)
                value = np.append(value, np.ones(fixed.size))
            assembled.append(sparse.coo_matrix((value, (row, column)), (total, total)).tocsc())
        return tuple(assembled)

    def shape(self, position: float) -> tuple[Array, Array]:
        """N (wheels, dofs) and F (wheels,) with the reference point at `position`."""
        number, inside = self.bay.locate(position + self.offsets)
        weights = np.zeros((self.offsets.size, self.stiffness.shape[0]))
        local = self.bay.shape(inside)
        for w, b in enumerate(number - self.first_bay):
            weights[w, b * self.bay.dofs:(b + 1) * self.bay.dofs + 2] = local[w]
        return weights, self.bay.flexibility(inside)

    def contact(self, indentation: Array) -> tuple[Array, Array]:
        """Force and its derivative."""
        contact = self.vehicle.contact
        pressed = np.maximum(indentation, 0.0)
        return (contact.stiffness * pressed**contact.exponent,
                contact.stiffness * contact.exponent * pressed ** (contact.exponent - 1.0))

    def stand(self, position: float, irregularity: Array) -> None:
        """Static equilibrium."""
        wheel, contact = self.vehicle.wheel, self.vehicle.contact
        n, local = self.shape(position)
        load = np.full(self.offsets.size, wheel.static_load)
        self.u = splu(self.stiffness).solve(-n.T @ load)
        self.v, self.a = np.zeros_like(self.u), np.zeros_like(self.u)
        self.f = load
        indentation = (wheel.static_load / contact.stiffness) ** (1.0 / contact.exponent)
        self.w = n @ self.u - local * load + irregularity - indentation
        self.w_v, self.w_a = np.zeros_like(self.w), np.zeros_like(self.w)
        self.started = True

    def step(self, position: float, irregularity: Array) -> None:
        """One Newmark step in displacements, all unknowns together."""
        dt, beta, gamma = self.time_step, self.beta, self.gamma
        wheel = self.vehicle.wheel
        n, local = self.shape(position)
        size, wheels = self.u.size, self.w.size
        u, w, f = self.u.copy(), self.w.copy(), self.f.copy()
        while True:
            a = ((u - self.u) / dt - self.v) / (beta * dt) - (0.5 / beta - 1.0) * self.a
            v = self.v + dt * ((1.0 - gamma) * self.a + gamma * a)
            w_a = ((w - self.w) / dt - self.w_v) / (beta * dt) - (0.5 / beta - 1.0) * self.w_a
            elastic, slope = self.contact(n @ u - local * f + irregularity - w)
            residual = np.concatenate([
                self.mass @ a + self.damping @ v + self.stiffness @ u + n.T @ f,
                wheel.mass * w_a - f + wheel.static_load,
                f - elastic,
            ])
            mass, damping, stiffness = self.matrices()
            track = mass / (beta * dt**2) + damping * (gamma / (beta * dt)) + stiffness
            d = sparse.diags(slope)
            one = sparse.identity(wheels)
            jacobian = sparse.bmat([
                [track, None, sparse.csc_matrix(n.T)],
                [None, one * (wheel.mass / (beta * dt**2)), -one],
                [-d @ sparse.csc_matrix(n), d, one + d @ sparse.diags(local)],
            ], format='csc')
            change = splu(jacobian).solve(-residual)
            self.factorisations += 1
            u += change[:size]
            w += change[size:size + wheels]
            f += change[size + wheels:]
            if np.abs(change[size + wheels:]).max() <= 1e-9 * wheel.static_load:
                break
        a = ((u - self.u) / dt - self.v) / (beta * dt) - (0.5 / beta - 1.0) * self.a
        w_a = ((w - self.w) / dt - self.w_v) / (beta * dt) - (0.5 / beta - 1.0) * self.w_a
        self.v = self.v + dt * ((1.0 - gamma) * self.a + gamma * a)
        self.w_v = self.w_v + dt * ((1.0 - gamma) * self.w_a + gamma * w_a)
        self.u, self.a, self.w, self.w_a, self.f = u, a, w, w_a, f

    def run(self, position: Array, irregularity: Array) -> ForwardResult:
        """As railtrack_ros.dynamics.newmark.FullModel.run."""
        result = ForwardResult.empty(len(position), self.offsets.size)
        for i, (x, r) in enumerate(zip(position, irregularity, strict=True)):
            if self.started:
                self.step(float(x), r)
            else:
                self.stand(float(x), r)
            n, local = self.shape(float(x))
            result.contact_force[i] = self.f
            result.rail_deflection[i] = n @ self.u - local * self.f
            result.wheel_displacement[i] = self.w
            result.axle_box_acceleration[i] = self.w_a
        return result
