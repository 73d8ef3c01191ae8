"""A step of force balance by machine code: what `Descent.step` does, frame by frame, without gradients.

On a processor the tensor operations of a step, some six hundred, take longer to begin than to work: on 33 x 33 vertices three
times, on 9 x 9 ten times as long as this. The formulas are those of `descent`, `camera_motion`, `cavity` and `kkt`.
"""

import numpy as np

from ..machine_code import compiled, fingerprint, kept
from ..mechanics import native_membrane
from ..mechanics.native_membrane import linearise
from ..solve import native_band
from ..solve.band import RIDGES
from ..solve.native_band import RANK, backward, factor
from . import native_equations
from .camera_motion import RARE
from .native_equations import USED, fill, load_forces, load_markers, sum_blocks, weigh


@compiled
def _step(c, work, u, pressure, moved, weights, seen, noise_level, gauge, scales):
    """From a state to the next: `u [m, n, 3]`, `pressure [1]`, `moved [4]` and `weights [N]`, of the normal tractions,
    change."""
    tau, outlier, cone, renewal, damping = scales[0], scales[1], scales[2], scales[3], scales[4]
    m, n = c.surface.free.shape
    rise = linearise(c.surface, u, pressure, work.force, work.A, work.volume) - c.numbers.rest_volume
    own, slope = np.zeros((4, 4)), np.zeros(4)
    weigh(c, work, weights, noise_level, tau, cone, renewal)
    fWv, vWv = load_forces(c, work)
    load_markers(c, work, u, moved, seen, outlier, own, slope)
    sum_blocks(c, work)
    width, size, y = work.width, len(work.inverse), work.y
    for ridge in RIDGES:
        fill(c, work, damping, ridge)
        if factor(work.U, len(work.panel) // RANK, width, size, work.inverse, work.panel, y):
            break
    else:
        y[:] = np.nan
    products = np.empty((USED, USED))
    for a in range(USED):
        for b in range(a + 1):
            products[a, b] = products[b, a] = _dot(y[a * size : (a + 1) * size], y[b * size : (b + 1) * size])
    following = _camera_eliminated(c.numbers, products, own, slope, moved, tau)
    multiplier, one, change = _shares(c.numbers, products, rise, pressure[0], fWv, vWv, gauge)
    solved, turn = y[:size], np.empty_like(moved)
    for i in range(size):
        solved[i] = multiplier * y[i] + one * y[size + i] + change * y[2 * size + i]
    for a in range(4):
        turn[a] = multiplier * following[a, 0] + one * following[a, 1] + change * following[a, 2]
        for i in range(size):
            solved[i] += turn[a] * y[(3 + a) * size + i]
    backward(work.U, len(work.panel) // RANK, width, size, work.inverse, solved)
    for i in range(size):
        solved[i] *= -work.scale[i]
    move = solved[: 3 * (m - 2) * (n - 2)].reshape((m - 2, n - 2, 3))
    share = _share(c, u, move)
    for i in range(m - 2):
        for j in range(n - 2):
            for a in range(3):
                u[i + 1, j + 1, a] += share * move[i, j, a]
    pressure[0] += share * change
    for a in range(4):
        moved[a] += share * turn[a]


@compiled
def _dot(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def _camera_eliminated(k, products, own, slope, moved, tau):
    """`CameraMotion.held` and `eliminated`: how the camera follows each load, `[4, 3]`; the loads' products become those with
    it."""
    play = k.camera_motion * (min(tau, k.first_tau) / k.last_tau) ** 2
    stiffness = RARE / (play**2 + _dot(moved, moved))
    system = np.empty((4, 7))
    for a in range(4):
        for b in range(7):
            system[a, b] = own[a, b] - products[3 + a, 3 + b] if b < 4 else products[3 + a, b - 4]
        system[a, a] += stiffness
        system[a, 5] -= slope[a] + stiffness * moved[a]
    for a in range(4):
        pivot = system[a, a]
        for e in range(7):
            system[a, e] /= pivot
        for b in range(4):
            share = system[b, a] if b != a else 0.0
            for e in range(7):
                system[b, e] -= share * system[a, e]
    for a in range(3):
        for b in range(3):
            for e in range(4):
                products[a, b] += products[a, 3 + e] * system[e, 4 + b]
    return system[:, 4:]


@compiled
def _shares(k, products, rise, pressure, fWv, vWv, gauge):
    """`Descent._shares`: of the volume's multiplier, the forces and the pressure's change in a step."""
    if k.is_open:
        return 0.0, 1.0, 0.0
    above = pressure - k.rest_pressure
    fWv, vWv = fWv - gauge[1] * (above - gauge[0]), vWv + gauge[1]
    target, compliance = -rise, 0.0
    if k.is_gas:
        ratio = k.gas_volume / (k.gas_volume + rise)
        compliance = k.gas_volume / (k.absolute * ratio**2)
        target = compliance * (k.absolute * (ratio - 1) - above)
    a11, a12, a22 = vWv - products[2, 2], compliance - products[0, 2], -products[0, 0]
    b1, b2 = fWv + products[2, 1], target + products[0, 1]
    det = a11 * a22 - a12 * a12
    return (a11 * b2 - a12 * b1) / det, 1.0, (b1 * a22 - a12 * b2) / det


@compiled
def _share(c, u, move):
    """`Descent._share`: so that no vertex goes far and no line of the grid is stretched or shrunk by much."""
    (m, n), rest, k, tiny = c.surface.free.shape, c.surface.rest, c.numbers, 1e-30
    far2, stretch2 = 0.0, 0.0
    here = np.zeros(3)
    for i in range(m):
        for j in range(n):
            inside = 0 < i < m - 1 and 0 < j < n - 1
            for a in range(3):
                here[a] = move[i - 1, j - 1, a] if inside else 0.0
            far2 = max(far2, here[0] ** 2 + here[1] ** 2 + here[2] ** 2)
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
    far2 = max(far2 / (k.longest_step * k.size) ** 2, stretch2 / k.largest_stretch**2, 1.0)
    return 1 / np.sqrt(far2)


def _entry(sources):
    @kept
    def steps(c, work, u, pressure, moved, weights, before, origins, across, weight, noise_level, motion, gauge, rows):
        """Steps of every frame: states `u [B, m, n, 3]`, `pressure [B]`, `moved [B, 4]` and `weights [B, N]`, of the normal
        tractions, become those after them; `before [B, m, n, 3]` the displacement before the last.

        c: `Constants`, work: a `Workspace`, origins to gauge: `Bearings`, rows: of every step tau, outlier, cone, renewal and
        damping, `[S, 5]`.
        """
        for b in range(len(u) if sources else 0):
            seen = origins[b], across[b], weight[b], motion[b]
            for k in range(len(rows)):
                if k == len(rows) - 1:
                    before[b] = u[b]
                state = u[b], pressure[b : b + 1], moved[b], weights[b]
                _step(c, work, *state, seen, noise_level[b], gauge[b], rows[k])

    return steps


steps = _entry(fingerprint(__file__, *(module.__file__ for module in (native_band, native_equations, native_membrane))))
