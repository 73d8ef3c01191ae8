"""Propagation of the markers' noise to force and depth as machine code: `deviations.spreads`, without gradients.

With `U^-T b` of all loads, all products `b . M^-1 b'` are known. Only the solutions for the wanted numbers, with camera and
cavity eliminated, need a back substitution.
"""

import numpy as np

from ....machine_code import compiled
from ....mechanics.native_membrane import linearise
from .equations import CAMERA, FLUID, LOADS, VOLUME, WANTED, load_forces, sum_blocks, weigh
from .gauss_newton import border_unknowns, cavity_condition, eliminated, factored, stiffness_at, substituted
from .markers import load_markers


@compiled
def spread_of(c, work, u, pressure, moved, seen, noise_level, gauge, outlier, damping, found):
    """Return the standard deviations `[4]` at the state of a frame, with the scale `outlier` of the markers' loss."""
    own, slope, shares = np.zeros((4, 4)), np.zeros(4), np.zeros(LOADS, u.dtype)
    rise = linearise(c.surface, u, pressure, work.x, work.cells, work.force, work.A, work.volume) - c.numbers.rest_volume
    weigh(c, work, noise_level, c.numbers.last_tau, np.bool_(True))
    vWv = load_forces(c, work)[1] + gauge[1]
    load_markers(c, work, u, moved, seen, outlier, own, slope)
    by_pressure = _load_wanted(c, work, u)
    sum_blocks(c, work)
    products = factored(c, work, damping, np.intp(LOADS))
    for a in range(4):
        own[a, a] += stiffness_at(c.numbers, moved, c.numbers.last_tau)
    following = _camera_eased(products, own)
    compliance = cavity_condition(c.numbers, rise, pressure[0])[1]
    for k in range(WANTED, LOADS):
        multiplier, change = 0.0, 0.0
        if not c.numbers.is_open:
            loads = by_pressure[k - WANTED] - products[FLUID, k], -products[VOLUME, k]
            multiplier, change = border_unknowns(products, vWv, compliance, *loads)
        shares[:] = 0
        shares[k], shares[VOLUME], shares[FLUID] = 1, -multiplier, -change
        for e in range(4):
            shares[CAMERA + e] = following[e, k] - multiplier * following[e, VOLUME] - change * following[e, FLUID]
        substituted(work, shares)
        found[k - WANTED] = np.sqrt(_at_markers(c, work, work.solved, own, seen[3]) + change**2 * gauge[1])


@compiled
def _load_wanted(c, work, u):
    """Write the loads of the wanted numbers: the derivatives of the total force and of the depth at the inner vertices; return
    those in the pressure, `[4]`."""
    (m, n), loads, by_pressure, deepest, count = c.surface.free.shape, work.loads, np.zeros(4), -np.inf, 0
    N = (m - 2) * (n - 2)
    depth = work.fields[0]
    for k in range(N):
        i, j = k // (n - 2) + 1, k % (n - 2) + 1
        depth[k] = u[i, j, 0] * c.inwards[k, 0] + u[i, j, 1] * c.inwards[k, 1] + u[i, j, 2] * c.inwards[k, 2]
        count = count + 1 if depth[k] == deepest else 1 if depth[k] > deepest else count
        deepest = max(deepest, depth[k])
        for a in range(3):
            if c.surface.free[i, j]:
                by_pressure[a] -= work.volume[i, j, a]
            for b in range(3):
                for s in range(7):
                    loads[WANTED + b, 3 * k + a] += work.A[a, 3 * s + b, i * n + j]
    for k in range(N):
        for a in range(3):
            loads[WANTED + 3, 3 * k + a] = c.inwards[k, a] / count if depth[k] == deepest else 0.0
    return by_pressure


@compiled
def _camera_eased(products, own):
    """Apply `CameraMotion.eliminate_camera`: return how the camera follows each load, `[4, LOADS]`, and include the camera in
    the products of the cavity's load with all loads."""
    system = np.empty((4, 4 + LOADS))
    for a in range(4):
        for b in range(4):
            system[a, b] = own[a, b] - products[CAMERA + a, CAMERA + b]
        for b in range(LOADS):
            system[a, 4 + b] = products[CAMERA + a, b]
    eliminated(system)
    for a in (VOLUME, FLUID):
        for b in range(LOADS):
            if not CAMERA <= b < WANTED:
                for e in range(4):
                    products[a, b] += products[a, CAMERA + e] * system[e, 4 + b]
    return system[:, 4:]


@compiled
def _at_markers(c, work, solved, own, motion):
    """Return the variance due to all markers' angles of a number whose equations have the solution `solved [3 N]`."""
    (corners, pulls), system, total = c.corners, np.empty((4, 5)), 0.0
    for a in range(4):
        for b in range(4):
            system[a, b] = own[a, b]
        system[a, 4] = 0.0
        for i in range(len(solved)):
            system[a, 4] += work.loads[CAMERA + a, i] * solved[i]
    eliminated(system)
    for d in range(len(corners)):
        for r in range(2):
            turned = 0.0
            for a in range(3):
                for s in range(3):
                    turned += work.jacobians[d, r, a] * pulls[d, s] * solved[3 * corners[d, s] + a]
            for a in range(4):
                turned -= work.marker_weights[d] * motion[r, a, d] * system[a, 4]
            total += turned * turned
    return total
