"""Slow, obvious second derivations of the infinite track, used by the tests alone.

Neither shares a formula with the product: no matrix exponential, no dynamic stiffness, no Bloch
waves.  Both take very many sleepers instead of infinitely many.
"""

import cmath
import math

import numpy as np
from scipy.sparse import lil_matrix
from scipy.sparse.linalg import spsolve


def characteristic_roots(rail, omega, foundation=0.0):
    """The two wavenumbers k (Im k < 0) of exp(-i k x) on the rail on a foundation."""
    loss = 1.0 + 1j * rail.loss_factor
    ei, kag = rail.bending_stiffness * loss, rail.shear_stiffness * loss
    inertia = foundation - rail.mass_per_length * omega**2
    turning = kag - rail.rotary_inertia * omega**2
    # (kag k2 + inertia) (ei k2 + turning) = kag^2 k2
    a, b, c = ei * kag, kag * turning + ei * inertia - kag**2, inertia * turning
    root = cmath.sqrt(b * b - 4.0 * a * c)
    ks = [cmath.sqrt((-b + sign * root) / (2.0 * a)) for sign in (1, -1)]
    return [k if k.imag < 0.0 else -k for k in ks]


def greens_function(rail, omega, x):
    """Free infinite rail: (w, theta) at x for a unit force and for a unit moment at 0.

    Residues of the Fourier integral.  Returns ((n, 2, 2)): [response, load].
    """
    x = np.asarray(x, dtype=float)
    loss = 1.0 + 1j * rail.loss_factor
    ei, kag = rail.bending_stiffness * loss, rail.shear_stiffness * loss
    k1, k2 = characteristic_roots(rail, omega)
    result = np.zeros((*x.shape, 2, 2), dtype=complex)
    for k, other in ((k1, k2), (k2, k1)):
        # 1 / [ei kag (s^2 - k1^2)(s^2 - k2^2)] around s = k, closed below.
        weight = -1j * np.exp(-1j * k * np.abs(x)) / (ei * kag * 2.0 * k * (k**2 - other**2))
        slope = 1j * kag * k * np.sign(x)
        result[..., 0, 0] += weight * (ei * k**2 + kag - rail.rotary_inertia * omega**2)
        result[..., 0, 1] += weight * slope
        result[..., 1, 0] -= weight * slope
        result[..., 1, 1] += weight * (kag * k**2 - rail.mass_per_length * omega**2)
    return result


def receptance_by_greens_function(track, frequency, force, responses, sleepers=241):
    """Rail receptances at `responses` for a force at x, and the displacement of sleeper 0.

    The rail is free; the supports are forces on it, found from their own law.
    """
    rail, support = track.rail, track.support
    omega = 2.0 * math.pi * frequency
    pad = support.pad_stiffness + 1j * omega * support.pad_damping
    ground = (support.ballast_stiffness + 1j * omega * support.ballast_damping
              - omega**2 * support.sleeper_mass)
    offsets, shares = np.array([0.0]), np.array([1.0])
    if support.kind == 'multipoint':
        offsets = support.pad_length * np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
        shares = np.array([1.0, 2.0, 2.0, 2.0, 1.0]) / 8.0
    rotating = support.kind == 'concentrated_rotational'
    numbers = np.arange(sleepers) - sleepers // 2
    x = (numbers[:, None] * support.spacing + offsets).ravel()

    # Unknown: spring forces r on the rail (and moments).  w = G r + G(x - force), and with the
    # sleeper eliminated  w_j = -r_j / k_j + w_s,  ground w_s = -sum r.
    n, points = x.size, offsets.size
    g = greens_function(rail, omega, x[:, None] - x[None, :])
    own = np.kron(np.eye(sleepers), np.ones((points, points)) / ground)
    law = np.diag(np.tile(1.0 / (shares * pad), sleepers)) + own
    load = greens_function(rail, omega, x - force)[:, :, 0]
    if rotating:
        turn = pad * support.pad_length**2 / 12.0
        matrix = np.block([[g[..., 0, 0] + law, g[..., 0, 1]],
                           [g[..., 1, 0], g[..., 1, 1] + np.eye(n) / turn]])
        reaction = np.linalg.solve(matrix, -np.concatenate([load[:, 0], load[:, 1]]))
    else:
        reaction = np.linalg.solve(g[..., 0, 0] + law, -load[:, 0])
    result = []
    for at in responses:
        here = greens_function(rail, omega, at - x)
        w = greens_function(rail, omega, np.array([at - force]))[0, 0, 0]
        w += here[:, 0, 0] @ reaction[:n]
        if rotating:
            w += here[:, 0, 1] @ reaction[n:]
        result.append(w)
    middle = slice((sleepers // 2) * points, (sleepers // 2 + 1) * points)
    return np.array(result), -reaction[middle].sum() / ground


def receptance_by_wave_amplitudes(track, frequency, force, responses, sleepers=241):
    """The same for distributed supports: four wave amplitudes in every piece of rail.

    Between pads and over them w is a sum of two decaying exponentials from either end of the
    piece, plus the particular solution of a moving sleeper; continuity and the sleepers' law tie
    the amplitudes together.  The outer ends of the row are clamped.
    """
    rail, support = track.rail, track.support
    omega = 2.0 * math.pi * frequency
    loss = 1.0 + 1j * rail.loss_factor
    ei, kag = rail.bending_stiffness * loss, rail.shear_stiffness * loss
    kd = (support.pad_stiffness + 1j * omega * support.pad_damping) / support.pad_length
    ground = (support.ballast_stiffness + 1j * omega * support.ballast_damping
              - omega**2 * support.sleeper_mass)
    half, spacing = 0.5 * support.pad_length, support.spacing

    numbers = np.arange(sleepers) - sleepers // 2
    cuts = np.concatenate([numbers * spacing - half, numbers * spacing + half,
                           [numbers[0] * spacing - 0.5 * spacing,
                            numbers[-1] * spacing + 0.5 * spacing]])
    cuts = np.unique(np.round(np.append(cuts, force), 9))
    middles = 0.5 * (cuts[1:] + cuts[:-1])
    owner = np.rint(middles / spacing).astype(int)
    over = np.abs(middles - owner * spacing) < half
    owner = owner - numbers[0]
    pieces = middles.size
    unknown = 4 * pieces + sleepers
    roots = {state: characteristic_roots(rail, omega, kd if state else 0.0)
             for state in (False, True)}
    particular = kd / (kd - rail.mass_per_length * omega**2)

    def fields(i, x):
        """Rows over the unknowns of (w, theta, Q, M) at x in piece i."""
        state = bool(over[i])
        inertia = (kd if state else 0.0) - rail.mass_per_length * omega**2
        columns, rows = [], []
        for j, k in enumerate(roots[state]):
            for sign, origin in ((1.0, cuts[i]), (-1.0, cuts[i + 1])):
                value = np.exp(-1j * k * abs(x - origin))
                d = -1j * k * sign  # d/dx
                theta = (d - inertia / (kag * d)) * value  # kag (w'' - theta') = inertia w
                q = inertia / d * value
                rows.append([value, theta, q, ei * d * theta])
                columns.append(4 * i + 2 * j + (0 if sign > 0 else 1))
        if state:
            rows.append([particular, 0.0, 0.0, 0.0])
            columns.append(4 * pieces + owner[i])
        return columns, np.array(rows).T

    matrix = lil_matrix((unknown, unknown), dtype=complex)
    right = np.zeros(unknown, dtype=complex)
    scale = [1.0, 1.0, 1.0 / abs(kag), 1.0 / abs(ei)]
    row = 0
    for i, end in ((0, 0), (pieces - 1, pieces)):
        columns, values = fields(i, cuts[end])
        for quantity in (0, 1):
            matrix[row, columns] = values[quantity]
            row += 1
    for i in range(pieces - 1):
        for quantity in range(4):
            columns, values = fields(i, cuts[i + 1])
            matrix[row, columns] = values[quantity] * scale[quantity]
            columns, values = fields(i + 1, cuts[i + 1])
            matrix[row, columns] = (matrix[row, columns].toarray().ravel()
                                    - values[quantity] * scale[quantity])
            if quantity == 2 and abs(cuts[i + 1] - force) < 1e-8:
                right[row] = scale[2]  # Q drops by the force: Q(-) - Q(+) = 1
            row += 1
    # Sleeper: ground ws = kd integral (w - ws) over its pad = Q jump plus the rail's inertia.
    for s in range(sleepers):
        own = 4 * pieces + s
        matrix[row, own] = -ground
        for i in np.flatnonzero(over & (owner == s)):
            length = cuts[i + 1] - cuts[i]
            for j, k in enumerate(roots[True]):
                integral = (1.0 - np.exp(-1j * k * length)) / (1j * k)
                matrix[row, 4 * i + 2 * j] = kd * integral
                matrix[row, 4 * i + 2 * j + 1] = kd * integral
            matrix[row, own] += kd * (particular - 1.0) * length
        scale_row = 1.0 / abs(ground + kd)
        matrix[row, :] = matrix[row, :] * scale_row
        row += 1
    solution = spsolve(matrix.tocsc(), right)
    result = []
    for at in responses:
        i = min(max(int(np.searchsorted(cuts, at)) - 1, 0), pieces - 1)
        columns, values = fields(i, at)
        result.append(values[0] @ solution[columns])
    return np.array(result), solution[4 * pieces + sleepers // 2]
