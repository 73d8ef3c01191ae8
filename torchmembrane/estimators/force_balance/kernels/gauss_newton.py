"""The steps of force balance as machine code: `GaussNewton.forward`, frame by frame, without gradients.

On a processor, calling the six hundred tensor operations of a step takes longer than computing them. The formulas are those of
`gauss_newton`, `camera_motion`, `cavity` and `kkt`.
"""

import numpy as np

from ....machine_code import compiled
from ....mechanics.cavity import gas_law_step
from ....mechanics.native_membrane import linearise
from ....solve.native_envelope import COLUMNS, ROWS, backward, factor_rows, forward, subtract_products
from ....solve.symmetric_2x2 import symmetric_solution
from ....vectors import BYTES
from ..camera_motion import camera_stiffness
from ..schedule import LEAST_MOVE, RELAXATION, falling, outlier_scale, scaled_step, share_of_next
from .equations import (
    CAMERA,
    FLUID,
    FORCES,
    VOLUME,
    WANTED,
    load_forces,
    load_weighted_forces,
    scale_rows,
    stiffness_change,
    sum_blocks,
    weigh,
    write_vertices,
)
from .markers import load_markers, load_markers_after

gas_step, solution_2x2, stiffness_of_camera = compiled(gas_law_step), compiled(symmetric_solution), compiled(camera_stiffness)
ratio_of_tau, scale_of_outliers, scaled = compiled(falling), compiled(outlier_scale), compiled(scaled_step)
next_share = compiled(share_of_next)
PART = 64
"""Number of rows whose products are summed in single precision; their sums are added in double precision."""


@compiled
def settle(c, work, u, pressure, moved, before, seen, noise_level, gauge, tau, steps, settling):
    """Take at most `steps` steps in place, the last `settling` of them relaxed, as `GaussNewton._next` does; `before [m, n, 3]`
    becomes the displacement before the last."""
    k, done, share = c.numbers, False, 1.0
    before[:] = u
    for j in range(steps):
        if not done:
            before[:] = u
            is_whole = j < steps - settling
            tau = tau if is_whole else k.last_tau
            step(c, work, u, pressure, moved, seen, noise_level, gauge, tau, share if is_whole else min(share, RELAXATION))
            moved_by = _scaled_step(c, u, before)
            done = not (tau > k.last_tau or moved_by > k.settled_step_tol)
            share = 1.0 if tau > k.last_tau else min(1.0, next_share(moved_by, k.settled_step_tol))
            tau = max(k.last_tau, tau * ratio_of_tau(max(moved_by, LEAST_MOVE)))


@compiled
def _scaled_step(c, u, before):
    """Return `GaussNewton._scaled_step` of a step."""
    (m, n), size = c.surface.free.shape, c.numbers.size
    moved, displacement = 0.0, 0.0
    for i in range(m):
        for j in range(n):
            for a in range(3):
                moved += (u[i, j, a] - before[i, j, a]) ** 2
                displacement += u[i, j, a] ** 2
    return scaled(np.sqrt(moved / (m * n)) / size, np.sqrt(displacement / (m * n)) / size)


@compiled
def step(c, work, u, pressure, moved, seen, noise_level, gauge, tau, share):
    """Take a share of one step in place: `u [m, n, 3]`, `pressure [1]` and `moved [4]` are overwritten.

    The linear system is solved twice: first as it stands, and then, with the same factor, from where the first solution leaves
    the linear equations. This is iterative refinement: the residual comes from the factors of the matrix (`stiffness_change`).
    """
    (m, n), k = c.surface.free.shape, c.numbers
    outlier = scale_of_outliers(k.outlier, tau / k.last_tau)
    rise = linearise(c.surface, u, pressure, work.x, work.cells, work.force, work.A, work.volume) - c.numbers.rest_volume
    own, slope = np.zeros((4, 4)), np.zeros(4)
    weigh(c, work, noise_level, tau, np.bool_(False))
    fWv, vWv = load_forces(c, work)
    load_markers(c, work, u, moved, seen, outlier, own, slope)
    stiffness, (target, compliance) = stiffness_at(k, moved, tau), cavity_condition(k, rise, pressure[0])
    for a in range(4):
        own[a, a] += stiffness
        slope[a] += stiffness * moved[a]
    sum_blocks(c, work)
    products = factored(c, work, 0.0, np.intp(WANTED))
    change, turn, shares, move = 0.0, np.zeros_like(moved), np.zeros(WANTED, u.dtype), work.move
    move[:] = 0
    for refined in range(2):
        if refined:
            fWv = _remaining_forces(c, work, change)
            slope[:] = 0
            load_markers_after(c, work, u, moved + turn, seen, slope)
            for a in range(4):
                slope[a] += stiffness * (moved[a] + turn[a])
            target -= compliance * change
            for i in range(len(work.solved)):
                target += work.loads[VOLUME, i] * work.solved[i]
            products = resolved(work)
        of_fluid = fWv - gauge[1] * (pressure[0] + change - k.rest_pressure - gauge[0])
        _share_out(k, products, own, slope, target, compliance, of_fluid, vWv + gauge[1], shares)
        substituted(work, shares)
        change += shares[FLUID]
        for a in range(4):
            turn[a] += shares[CAMERA + a]
        for i in range(len(work.solved)):
            move[i] += work.solved[i]
    share *= _share(c, u, move[: 3 * (m - 2) * (n - 2)].reshape((m - 2, n - 2, 3)))
    for i in range(m - 2):
        for j in range(n - 2):
            for a in range(3):
                u[i + 1, j + 1, a] -= share * move[3 * (i * (n - 2) + j) + a]
    pressure[0] += share * change
    for a in range(4):
        moved[a] += share * turn[a]


@compiled
def _remaining_forces(c, work, rise):
    """Replace the forces by those after a step, to first order: the vertices moved by `-solved`, and the pressure by `rise`;
    write their load, and return `f W v`."""
    m, n = c.surface.free.shape
    for k in range((m - 2) * (n - 2)):
        for a in range(3):
            work.of_loads[a, 0, (k // (n - 2) + 1) * n + k % (n - 2) + 1] = work.solved[3 * k + a]
    stiffness_change(work, m, n)
    for k in range((m - 2) * (n - 2)):
        i, j = k // (n - 2) + 1, k % (n - 2) + 1
        for a in range(3 if c.surface.free[i, j] else 0):
            work.force[i, j, a] -= work.sums[a, i * n + j] + rise * work.volume[i, j, a]
    return load_weighted_forces(c, work)


@compiled
def factored(c, work, damping, used):
    """Factor the matrix; write `U^-T b` to `y` for the first `used` loads `b`, and return the products `b . M^-1 b'` of all,
    `[COLUMNS, COLUMNS]`."""
    scale_rows(c, work, damping)
    R, tried, found = np.empty(ROWS * ROWS, work.U.dtype), 0, False
    while not found and tried < len(work.ridges):
        first, found = 0, True
        while found and first < len(work.scale):
            write_vertices(work, -(-first // 3), -(-(first + ROWS) // 3), work.ridges[tried], used)
            found = factor_rows(work.U, work.layout.places, first, work.inverse, work.y, used, R)
            first += ROWS
        tried += 1
    if not found:
        work.y[:] = np.nan
    return _products(work, used)


@compiled
def resolved(work):
    """Solve `U^T y = b` again for the load of the forces alone, and return the products as `factored` does."""
    half, order = work.half_solved, work.layout.order
    half[3 * len(order) :] = 0
    for k in range(len(order)):
        for a in range(3):
            half[3 * k + a] = work.loads[FORCES, 3 * order[k] + a] * work.scale[3 * k + a]
    forward(work.U, work.layout.places, work.inverse, half)
    for i in range(len(half)):
        work.y[i * COLUMNS + FORCES] = half[i]
    return _products(work, np.intp(WANTED))


@compiled
def _products(work, used):
    """Return the products of the first `used` columns of `y [3 N, COLUMNS]`, `[COLUMNS, COLUMNS]`. Those of `PART` rows are
    summed at a time."""
    y, of_rows, products = work.y, work.layout.places.loads, np.zeros((COLUMNS, COLUMNS))
    part, lanes = np.empty(COLUMNS * COLUMNS, y.dtype), BYTES // y.itemsize
    for first in range(0, len(of_rows), PART):
        part[:] = 0
        end = min(first + PART, len(of_rows))
        for a in range(0, used, ROWS):
            for b in range(0, used, lanes):
                subtract_products(part, a * COLUMNS + b, COLUMNS, y, of_rows, a, y, of_rows, b, first, end)
        for a in range(used):
            for b in range(used):
                products[a, b] -= part[a * COLUMNS + b]
    return products


@compiled
def substituted(work, shares):
    """Solve `M x = sum_l shares[l] b_l` and write x to `solved [3 N]`; `factored` has written `U^-T b_l` to `y`."""
    half, order = work.half_solved, work.layout.order
    for i in range(len(half)):
        total = shares[0] * work.y[i * COLUMNS]
        for load in range(1, len(shares)):
            total += shares[load] * work.y[i * COLUMNS + load]
        half[i] = total
    backward(work.U, work.layout.places, work.inverse, half)
    for k in range(len(order)):
        for a in range(3):
            work.solved[3 * order[k] + a] = half[3 * k + a] * work.scale[3 * k + a]


@compiled
def blunt_at(k, tau):
    """Return by how much a step at a scale `tau` lets the camera move more than at the last one."""
    return (min(tau, k.first_tau) / k.last_tau) ** 2


@compiled
def stiffness_at(k, moved, tau):
    """Return the camera's stiffness at a scale `tau` of the tractions' loss."""
    play = k.camera_motion * blunt_at(k, tau)
    moved2 = 0.0  # summed in double precision
    for a in range(4):
        moved2 += moved[a] ** 2
    return stiffness_of_camera(play, moved2)


@compiled
def eliminated(system):
    """Solve `[A b] [4, 4 + n]` in place; the solutions are in the columns of `b`."""
    for a in range(len(system)):
        pivot = system[a, a]
        for e in range(system.shape[1]):
            system[a, e] /= pivot
        for b in range(len(system)):
            share = system[b, a] if b != a else 0.0
            for e in range(system.shape[1]):
                system[b, e] -= share * system[a, e]


@compiled
def _camera_eliminated(products, own, slope):
    """Apply `CameraMotion.eliminated`: return how the camera follows each load, `[4, 3]`, and include the camera in the
    products of the loads."""
    system = np.empty((4, 7))
    for a in range(4):
        for b in range(4):
            system[a, b] = own[a, b] - products[CAMERA + a, CAMERA + b]
        for b in range(3):
            system[a, 4 + b] = products[CAMERA + a, b]
        system[a, 4 + FORCES] -= slope[a]
    eliminated(system)
    for a in range(3):
        for b in range(3):
            for e in range(4):
                products[a, b] += products[a, CAMERA + e] * system[e, 4 + b]
    return system[:, 4:]


@compiled
def _share_out(k, products, own, slope, target, compliance, of_fluid, vWv, shares):
    """Write the shares `[WANTED]` of the loads in a negative step, as `GaussNewton._shares` and `CameraMotion.eliminated` do:
    of the volume it is the multiplier, of the fluid the increase of the pressure, and of the camera its motion."""
    following = _camera_eliminated(products, own, slope)
    shares[:] = 0
    shares[FORCES] = 1
    if not k.is_open:
        loads = of_fluid + products[FLUID, FORCES], target + products[VOLUME, FORCES]
        shares[VOLUME], shares[FLUID] = border_unknowns(products, vWv, compliance, *loads)
    for a in range(4):
        for b in range(3):
            shares[CAMERA + a] += following[a, b] * shares[b]


@compiled
def cavity_condition(k, rise, pressure):
    """Return `CavityLaw.condition`."""
    if not k.is_gas:
        return -rise, 0.0
    return gas_step(rise, pressure, k.rest_pressure, k.absolute, k.gas_volume)


@compiled
def border_unknowns(products, vWv, compliance, of_fluid, of_volume):
    """Apply `kkt.border_unknowns`: return the volume's multiplier and the pressure change from the right-hand sides of their
    rows."""
    corner, beside = vWv - products[FLUID, FLUID], compliance - products[VOLUME, FLUID]
    change, multiplier = solution_2x2(corner, beside, -products[VOLUME, VOLUME], of_fluid, of_volume)
    return multiplier, change


@compiled
def _share(c, u, move):
    """Apply `GaussNewton._share`: return the share of the step that limits the stretch of every grid edge."""
    (m, n), rest, k, tiny = c.surface.free.shape, c.surface.rest, c.numbers, 1e-30
    stretch2 = 0.0
    here = np.zeros(3)
    for i in range(m):
        for j in range(n):
            inside = 0 < i < m - 1 and 0 < j < n - 1
            for a in range(3):
                here[a] = move[i - 1, j - 1, a] if inside else 0.0
            for axis in range(2):
                p, q = i + 1 - axis, j + axis
                if p < m and q < n:
                    inner = 0 < p < m - 1 and 0 < q < n - 1
                    change2, edge2 = 0.0, 0.0
                    for a in range(3):
                        change = (move[p - 1, q - 1, a] if inner else 0.0) - here[a]
                        edge = rest[p, q, a] - rest[i, j, a] + (u[p, q, a] - u[i, j, a])
                        change2 += change * change
                        edge2 += edge * edge
                    stretch2 = max(stretch2, change2 / max(edge2, tiny))
    return 1 / np.sqrt(max(stretch2 / k.largest_stretch**2, 1.0))
