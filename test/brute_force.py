"""The full model by brute force: the slow obvious twin for supports and wheels of any kind.

A fixed row of bays, dense matrices, every displacement of track and wheelsets an unknown of one
Newton iteration a step, laws of pads, ballast and contacts written down from their definitions.
Nothing is shared with the fast model but the bays' matrices and interpolation, and the wheelset's.
"""

from __future__ import annotations

import numpy as np

from railtrack_ros.dynamics.wheelset import wheelset_matrices


class BruteForce:
    """Wheels on bays first .. first + count - 1 of a row (track.row.BayRow), ends clamped."""

    def __init__(self, row, vehicle, offsets, step, first, count, beta=0.25, gamma=0.5):
        self.vehicle, self.offsets = vehicle, np.asarray(offsets, dtype=float)
        self.step_size, self.beta, self.gamma, self.first = step, beta, gamma, first
        self.bays = [row.kinds[k] for k in row.kind(first, count)]
        nb = self.nb = row.bay.dofs
        self.track_size = count * nb + 2
        m_w, c_w, k_w, self.contact_shape, self.box_shape = wheelset_matrices(vehicle.wheel)
        own = self.own = len(m_w)
        size = self.track_size + own * self.offsets.size
        self.m, self.c, self.k = (np.zeros((size, size)) for _ in range(3))
        for b, bay in enumerate(self.bays):
            part = slice(b * nb, (b + 1) * nb + 2)
            for whole, matrix in ((self.m, bay.mass), (self.c, bay.damping),
                                  (self.k, bay.stiffness)):
                whole[part, part] += matrix
        for w in range(self.offsets.size):
            part = self.wheel(w)
            self.m[part, part], self.c[part, part], self.k[part, part] = m_w, c_w, k_w
        self.free = np.setdiff1d(np.arange(size),
                                 [0, 1, self.track_size - 2, self.track_size - 1])
        self.supports = [(row, sleeper, support) for row, sleeper, support in self.pads()
                         if not support.linear]
        self.u = None

    def wheel(self, w):
        begin = self.track_size + w * self.own
        return slice(begin, begin + self.own)

    def pads(self):
        """Per bay: pad compression row, sleeper's index, support."""
        for b, bay in enumerate(self.bays):
            support, row = bay.track.support, np.zeros(self.k.shape[0])
            # Mean rail deflection over the pad, by its definition.
            if support.kind == 'distributed':
                x = (np.arange(1000) + 0.5) / 1000 - 0.5
                weights = bay.shape(-bay.start + support.pad_length * x).mean(axis=0)
            elif support.kind == 'multipoint':
                quarter = 0.25 * support.pad_length * np.arange(-2, 3)
                weights = np.array([0.125, 0.25, 0.25, 0.25, 0.125]) @ bay.shape(
                    -bay.start + quarter)
            else:
                weights = bay.shape(-bay.start)[0]
            row[b * self.nb:(b + 1) * self.nb + 2] -= weights
            row[b * self.nb + bay.sleeper_dof] += 1.0
            yield row, b * self.nb + bay.sleeper_dof, support

    def support_forces(self, u, v, forces, d_u, d_v):
        """Subtract what pads and ballast exert beyond K u + C v, and its derivatives."""
        for row, sleeper, support in self.supports:
            if support.pad_nonlinearity:
                law = support.pad_nonlinearity
                k1 = law.unloaded_stiffness
                d0 = 3.0 * law.preload / (2.0 * k1 + support.pad_stiffness)
                k3 = (law.preload - k1 * d0) / d0**3
                d = d0 + row @ u
                whole = k1 * d + k3 * d**3 if d > 0.0 else 0.0
                slope = k1 + 3.0 * k3 * d**2 if d > 0.0 else 0.0
                forces += row * (whole - law.preload - support.pad_stiffness * (row @ u))
                d_u += np.outer(row, row) * (slope - support.pad_stiffness)
            if support.ballast_lift_off:
                law = support.ballast_lift_off
                k, c = support.ballast_stiffness, support.ballast_damping
                at_rest = law.preload if law.gap == 0.0 else 0.0
                pressed = at_rest - k * (u[sleeper] + law.gap) - c * v[sleeper]
                up = max(0.0, pressed) - at_rest
                forces[sleeper] -= up + k * u[sleeper] + c * v[sleeper]
                if pressed <= 0.0:
                    d_u[sleeper, sleeper] -= k
                    d_v[sleeper, sleeper] -= c

    def gradients(self, position):
        """Indentation = g u + irregularity - F f, rows g (wheels, unknowns), and F (wheels,)."""
        start, spacing = self.bays[0].start, self.bays[0].spacing
        g, local = np.zeros((self.offsets.size, self.k.shape[0])), np.zeros(self.offsets.size)
        for w, x in enumerate(position + self.offsets):
            number = int(np.floor((x - start) / spacing))
            bay, inside = self.bays[number - self.first], x - start - number * spacing
            begin = (number - self.first) * self.nb
            g[w, begin:begin + self.nb + 2] = bay.shape(inside)[0]
            g[w, self.wheel(w)] = -self.contact_shape
            local[w] = bay.flexibility(inside)[0]
        return g, local

    def contact(self, w, delta, moving):
        """Force and its slope: Hunt and Crossley, the rate by backward differences."""
        law, load = self.vehicle.contact, self.vehicle.wheel.static_load
        if delta <= 0.0:
            return 0.0, 0.0
        rate = by_delta = 0.0
        if moving:
            rate = (1.5 * delta - 2.0 * self.delta[w] + 0.5 * self.earlier[w]) / self.step_size
            by_delta = 1.5 / self.step_size
        elastic = law.stiffness * delta**law.exponent
        factor = 1.0 + law.damping / load * rate
        if factor <= 0.0:
            return 0.0, 0.0
        return (elastic * factor, law.exponent * elastic / delta * factor
                + elastic * law.damping / load * by_delta)

    def solve(self, position, irregularity, moving):
        """Newton on displacements and contact forces; static without `moving`."""
        dt, beta, gamma = self.step_size, self.beta, self.gamma
        wheels, size = self.offsets.size, self.k.shape[0]
        g, local = self.gradients(position)
        u, f = self.u.copy(), self.f.copy()
        for _ in range(200):
            a = v = np.zeros(size)
            if moving:
                a = ((u - self.u) / dt - self.v) / (beta * dt) - (0.5 / beta - 1.0) * self.a
                v = self.v + dt * ((1.0 - gamma) * self.a + gamma * a)
            forces = self.m @ a + self.c @ v + self.k @ u
            d_u, d_v = self.k.copy(), np.zeros_like(self.k)
            self.support_forces(u, v, forces, d_u, d_v)
            for w in range(wheels):
                forces[self.wheel(w)] += self.contact_shape * self.vehicle.wheel.static_load
            forces += g.T @ f
            if moving:
                d_u += self.m / (beta * dt**2) + (self.c + d_v) * gamma / (beta * dt)
            delta = g @ u + irregularity - local * f
            law, slope = np.array([self.contact(w, delta[w], moving) for w in range(wheels)]).T
            jacobian = np.block([[d_u, g.T], [-slope[:, None] * g,
                                              np.eye(wheels) + np.diag(slope * local)]])
            residual = np.concatenate([forces, f - law])
            keep = np.concatenate([self.free, size + np.arange(wheels)])
            change = np.zeros(size + wheels)
            change[keep] = np.linalg.solve(jacobian[np.ix_(keep, keep)], -residual[keep])
            u += change[:size]
            f += change[size:]
            if np.abs(change[size:]).max() < 1e-6 and np.abs(change[:size]).max() < 1e-13:
                break
        else:
            raise AssertionError('the twin does not converge')
        self.earlier, self.delta = self.delta if moving else delta, delta
        self.v, self.a, self.u, self.f = v, a, u, f

    def run(self, position, irregularity):
        """Arrays (n, wheels) in the order of ForwardResult."""
        out = np.zeros((4, len(position), self.offsets.size))
        for i, (x, r) in enumerate(zip(position, irregularity, strict=True)):
            if self.u is None:
                wheel, law = self.vehicle.wheel, self.vehicle.contact
                self.u = np.zeros(self.k.shape[0])
                self.f = np.full(self.offsets.size, wheel.static_load)
                self.v = self.a = np.zeros_like(self.u)
                self.delta = self.earlier = np.full(
                    self.offsets.size, (wheel.static_load / law.stiffness) ** (1 / law.exponent))
                for w in range(self.offsets.size):
                    self.u[self.wheel(w)][0] = r[w] - self.delta[w]
                self.solve(x, r, False)
            else:
                self.solve(x, r, True)
            g, local = self.gradients(x)
            for w in range(self.offsets.size):
                q = self.u[self.wheel(w)]
                out[0, i, w] = self.f[w]
                out[2, i, w] = self.contact_shape @ q
                out[1, i, w] = (g[w, :self.track_size] @ self.u[:self.track_size]
                                - local[w] * self.f[w])
                out[3, i, w] = self.box_shape @ self.a[self.wheel(w)]
        return out
